import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud


def sequence_of(clouds: list[GaussianCloud], times: list[float] | None = None) -> GaussianSequence:
    return GaussianSequence(
        lambda i: clouds[i], num_splats=len(clouds[0]), sh_degree=clouds[0].sh_degree, frame_times=times, num_frames=len(clouds)
    )


@pytest.mark.parametrize(
    ("t", "expected"),
    [
        (-1.0, (0, 1, 0.0)),
        (0.0, (0, 1, 0.0)),
        (0.25, (0, 1, 0.5)),
        (0.5, (1, 2, 0.0)),
        (0.75, (1, 2, 0.5)),
        (1.0, (2, 2, 0.0)),
        (9.0, (2, 2, 0.0)),
    ],
)
def test_bracket__of_uniform_times(t: float, expected: tuple[int, int, float]) -> None:
    assert sequence_of([random_cloud(1)] * 3).bracket(t) == expected


def test_bracket__of_equal_times_has_no_fraction() -> None:
    sequence = sequence_of([random_cloud(1)] * 4, [0.0, 0.5, 0.5, 1.0])

    assert sequence.bracket(0.5) == (2, 3, 0.0)
    assert sequence.bracket(0.25) == (0, 1, 0.5)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8).map(sorted), st.floats(-0.5, 1.5))
def test_bracket__contains_the_time(times: list[float], t: float) -> None:
    first, second, fraction = sequence_of([random_cloud(1)] * len(times), times).bracket(t)

    inside = min(max(t, times[0]), times[-1])
    assert 0 <= fraction <= 1
    assert np.isclose(times[first] + fraction * (times[second] - times[first]), inside)


def test_at__interpolates_scales_in_the_log_domain_and_opacity_after_the_sigmoid() -> None:
    a = random_cloud(1).replace(log_scales=np.log([[1.0, 2.0, 4.0]]), opacity_logits=np.array([-np.inf]))
    b = random_cloud(1).replace(log_scales=np.log([[4.0, 2.0, 1.0]]), opacity_logits=np.array([np.inf]))

    middle = sequence_of([a, b]).at(0.5)

    assert np.allclose(np.exp(middle.log_scales), [[2.0, 2.0, 2.0]], rtol=1e-6)
    assert np.allclose(middle.opacity_logits, 0.0, atol=1e-6)


def test_at__takes_the_shorter_way_between_rotations() -> None:
    a = random_cloud(1).replace(quats=np.array([[1.0, 0, 0, 0]]))
    b = random_cloud(1).replace(quats=np.array([[-np.cos(0.4), -np.sin(0.4), 0, 0]]))

    middle = sequence_of([a, b]).at(0.5)

    assert np.allclose(np.abs(middle.quats), [[np.cos(0.2), np.sin(0.2), 0, 0]], atol=1e-6)


def test_at__hides_what_is_fainter_than_one_255th_in_both_modes() -> None:
    levels = np.array([0.9 / 255, 1.0 / 255, 1.1 / 255])
    cloud = random_cloud(3).replace(opacity_logits=np.log(levels / (1 - levels)))

    for mode in ("linear", "nearest"):
        shown = np.isfinite(sequence_of([cloud, cloud]).at(0.3, mode).opacity_logits)  # type: ignore[arg-type]
        assert shown.tolist() == [False, True, True]


@pytest.mark.parametrize("times", [[], [0.5, 0.2], [0.0, 1.5], [np.nan]])
def test_sequence__refuses_times_that_do_not_run_from_0_to_1(times: list[float]) -> None:
    with pytest.raises(CloudError):
        GaussianSequence(lambda _i: random_cloud(1), num_splats=1, sh_degree=3, frame_times=times)


def test_frame__names_the_frames_there_are() -> None:
    with pytest.raises(CloudError, match=r"0\.\.1, found 2"):
        sequence_of([random_cloud(1)] * 2).frame(2)
