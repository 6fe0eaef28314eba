import warnings

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud, TimeModel
from gsplat_tools.errors import CloudError, LossyConversionWarning
from gsplat_tools.ops.motion import bake, visible_splats
from gsplat_tools.ops.motion_fitting import fit_motion
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud

FRAMES = 41


def moving(model: TimeModel, count: int = 300) -> GaussianCloud:
    cloud = random_cloud(count, sh_degree=1, motion=True)
    return cloud.replace(time_model=model, opacity_logits=np.abs(cloud.opacity_logits) * 0.5)


def baked(cloud: GaussianCloud, frames: int = FRAMES) -> tuple[GaussianSequence, GaussianCloud]:
    """Keyframes, and the splats of the cloud that they hold."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LossyConversionWarning)
        return bake(cloud, frames), cloud.take(visible_splats(cloud, np.linspace(0, 1, frames)))


def sequence_of(frames: list[GaussianCloud]) -> GaussianSequence:
    return GaussianSequence(
        frames.__getitem__, num_splats=len(frames[0]), sh_degree=frames[0].sh_degree, num_frames=len(frames)
    )


def test_fit_motion__finds_the_windows_and_lines_that_were_baked() -> None:
    sequence, source = baked(moving("window"))

    fitted, residuals = fit_motion(sequence)

    assert fitted.time_model == "window"
    for name in ("sh0", "shN", "log_scales"):
        assert np.allclose(getattr(fitted, name), getattr(source, name), rtol=1e-6)
    assert source.times is not None
    assert source.durations is not None
    assert fitted.times is not None
    assert fitted.durations is not None
    # A window is known to half a frame at each end.
    half = 0.5 / (FRAMES - 1) + 1e-6
    assert np.abs(fitted.times - source.times).max() <= half
    assert np.abs(np.minimum(source.times + source.durations, 1) - (fitted.times + fitted.durations)).max() <= half
    told = residuals.visible_frames >= 2
    assert np.abs(fitted.velocities - source.velocities)[told].max() < 1e-3  # float32 positions over one frame
    assert residuals.position_max.max() < 1e-5
    assert residuals.opacity_max.max() < 1e-6
    assert residuals.rotation_max.max() < 1e-5
    assert residuals.log_scale_rms.max() < 1e-6


def test_fit_motion__finds_the_gaussians_that_were_baked() -> None:
    sequence, source = baked(moving("gaussian"))

    fitted, residuals = fit_motion(sequence, time_model="gaussian")

    told = residuals.visible_frames >= 4
    for name in ("times", "durations"):
        assert np.abs(getattr(fitted, name) - getattr(source, name))[told].max() < 1e-4
    assert np.abs(fitted.means - source.means)[told].max() < 1e-4
    assert residuals.opacity_max[told].max() < 1e-4


@pytest.mark.parametrize("model", ["window", "gaussian"])
def test_fit_motion__tells_the_models_apart(model: TimeModel) -> None:
    sequence, _ = baked(moving(model))

    assert fit_motion(sequence, time_model="auto")[0].time_model == model


def test_fit_motion__reports_each_splat_that_a_line_does_not_describe() -> None:
    # The first splat circles with radius 1, the second stands, the third blinks off in one frame of the middle.
    start = random_cloud(3, sh_degree=0).replace(opacity_logits=np.full(3, 3.0))
    frames = []
    for angle in np.linspace(0, 2 * np.pi, 9):
        means = start.means.copy()
        means[0] = [np.cos(angle), np.sin(angle), 0]
        logits = start.opacity_logits.copy()
        logits[2] = -20 if len(frames) == 4 else 3
        frames.append(start.replace(means=means, opacity_logits=logits))

    cloud, residuals = fit_motion(sequence_of(frames))

    # cos and sin of 9 steps: along x nothing is linear; along y the best slope takes off a part of the variance.
    t = np.linspace(0, 1, 9)
    x, y = np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)
    left = [values - np.polyval(np.polyfit(t, values, 1), t) for values in (x, y)]
    assert residuals.position_rms[0] == pytest.approx(np.sqrt(np.mean(left[0] ** 2 + left[1] ** 2)), rel=1e-5)
    assert residuals.position_rms[1] < 1e-6
    assert residuals.visible_frames.tolist() == [9, 9, 8]
    opacity = 1 / (1 + np.exp(-3))
    assert residuals.opacity_max.tolist() == pytest.approx([0, 0, opacity], abs=1e-6)
    assert residuals.opacity_rms[2] == pytest.approx(opacity / 3, rel=1e-5)  # one frame of nine
    assert "position" in residuals.summary()
    assert len(cloud) == 3


def test_fit_motion__reports_what_turns_or_grows() -> None:
    start = random_cloud(2, sh_degree=0).replace(
        quats=np.array([[1.0, 0, 0, 0]] * 2), log_scales=np.zeros((2, 3)), opacity_logits=np.full(2, 2.0)
    )
    end = start.replace(
        quats=np.array([[np.cos(0.3), np.sin(0.3), 0, 0], [1, 0, 0, 0]]), log_scales=np.array([[0, 0, 0], [1.0, 1, 1]])
    )

    fitted, residuals = fit_motion(sequence_of([start, end]))

    assert residuals.rotation_max == pytest.approx([0.3, 0], abs=1e-6)  # half of the 0.6 radians between the two
    assert residuals.log_scale_rms == pytest.approx([0, 0.5], abs=1e-6)
    assert fitted.log_scales[1] == pytest.approx([0.5] * 3)


def test_fit_motion__takes_quaternions_of_either_sign_for_one_rotation() -> None:
    cloud = random_cloud(5, sh_degree=0).replace(opacity_logits=np.full(5, 2.0))

    _, residuals = fit_motion(sequence_of([cloud, cloud.replace(quats=-cloud.quats)]))

    assert residuals.rotation_max.max() < 1e-6


def test_fit_motion__of_one_frame_stands_still_and_always_shows() -> None:
    cloud = random_cloud(4, sh_degree=1).replace(opacity_logits=np.full(4, 2.0))

    for model in ("window", "gaussian"):
        fitted, residuals = fit_motion(sequence_of([cloud]), time_model=model)  # type: ignore[arg-type]
        assert fitted.velocities is not None
        assert not fitted.velocities.any()
        assert np.allclose(fitted.means, cloud.means, atol=1e-6)
        assert residuals.opacity_max.max() < 0.5 / 255


def test_fit_motion__drops_what_no_frame_shows_and_names_the_rest() -> None:
    cloud = random_cloud(4, sh_degree=0).replace(opacity_logits=np.array([2, -20, 2, -20]))

    with pytest.warns(LossyConversionWarning, match="dropped 2 of 4"):
        fitted, residuals = fit_motion(sequence_of([cloud, cloud]))

    assert len(fitted) == 2
    assert residuals.splats.tolist() == [0, 2]


def test_fit_motion__refuses_frames_that_differ() -> None:
    frames = [random_cloud(3, sh_degree=0), random_cloud(4, sh_degree=0)]

    with pytest.raises(CloudError, match="expected 3 splats"):
        fit_motion(sequence_of(frames))


def test_fit_motion__passes_on_what_is_not_finite() -> None:
    cloud = random_cloud(3, sh_degree=0).replace(opacity_logits=np.full(3, 2.0))
    means = cloud.means.copy()
    means[1, 0] = np.inf

    fitted, _ = fit_motion(sequence_of([cloud, cloud.replace(means=means)]), time_model="auto")

    assert np.isfinite(fitted.means).all(axis=1).tolist() == [True, False, True]
