"""What adds up: compositing of 100,000 layers, chains of changes over a thousand frames and more; against closed forms."""

from __future__ import annotations

import io
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gsplat_tools.attributes import activations
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import attribute_errors
from gsplat_tools.formats._label_delta import UPDATE, DeltaSegment, changes, read_delta, write_delta
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.numerics.exact import HALF_STEP, MP
from tests.reference.splats import FOCAL, camera, splats

LAYERS = 100_000


# -- compositing


@dataclass(frozen=True)
class Rules:
    """What a model does with a ball on the axis, from docs/rendering.md; nothing of it is read from the product."""

    low_pass: float
    floor: float
    cutoff: float
    compensates: bool = False
    compensation_slack: float = 0.0
    cap: float = 1.0
    longest_axis: float = np.inf
    variant: str | None = None


SIDE = 4
RULES = {
    "inria": Rules(low_pass=0.3, floor=1 / 255, cutoff=np.inf, cap=0.99),
    # Quads reach two axes: an axis is at most half of the picture's side. Its edge term is below 1e-5 at these pixels.
    "unity": Rules(low_pass=0.075, floor=1 / 255, cutoff=4.0, longest_axis=SIDE / 2),
    "spark": Rules(low_pass=0.3, floor=0.5 / 255, cutoff=4.0, compensates=True, longest_axis=256.0, variant="none"),
    "visionary": Rules(
        low_pass=0.1,
        floor=0.0,
        cutoff=2 * np.sqrt(np.log(255)),
        compensates=True,
        compensation_slack=1e-6,
        cap=0.99,
        variant="float",
    ),
}


def layer_alphas(rules: Rules, size: float, opacity: float, depths: np.ndarray) -> np.ndarray:
    """Alphas (layers, SIDE, SIDE) of balls on the axis, in float64."""
    spread = (FOCAL * size / depths) ** 2
    wide = spread + rules.low_pass
    if rules.compensates:
        slack = rules.compensation_slack
        opacity = opacity * np.sqrt(spread**2 / (wide**2 + slack) + slack)
    axes = np.minimum(np.sqrt(2 * wide), rules.longest_axis)
    offsets = np.arange(SIDE) + 0.5 - SIDE / 2
    q = (offsets**2 + offsets[:, None] ** 2) / axes[:, None, None] ** 2
    alphas = np.minimum(rules.cap, np.reshape(opacity, (-1, 1, 1)) * np.exp(-q))
    return np.where((q <= rules.cutoff) & (alphas >= rules.floor), alphas, 0.0)


def composite(alphas: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image and alphas of layers, nearest first: weights are alphas times the product of what is before them."""
    transmittance = np.cumprod(1 - alphas, axis=0)
    before = np.concatenate([np.ones((1, SIDE, SIDE)), transmittance[:-1]])
    return np.tensordot(alphas * before, colors, axes=(0, 0)), 1 - transmittance[-1]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("model", ["unity", "spark", "visionary"])
@pytest.mark.parametrize("opacity", [0.02, 0.5])
def test_blending__of_a_hundred_thousand_layers_is_the_sum_of_their_weights(model: str, opacity: float, dtype: Any) -> None:
    rules = RULES[model]
    colors = np.tile([[0.9, 0.1, 0.5], [0.2, 0.7, 0.5]], (LAYERS // 2, 1))
    depths = np.linspace(5.0, 6.0, LAYERS)
    # In float32, as the cloud holds them; the nearest first, so that models that draw the farthest first must sort.
    means = np.stack([np.zeros(LAYERS), np.zeros(LAYERS), depths], axis=1)
    cloud = splats(means, scales=5.0, opacities=opacity, colors=colors)

    found = render(cloud, camera(SIDE, SIDE, near=0.2, far=10.0), model=model, variant=rules.variant, dtype=dtype)

    alphas = layer_alphas(rules, 5.0, opacity, cloud.means[:, 2].astype(np.float64))
    image, covered = composite(alphas, colors)
    # Each layer rounds a few times and hides what came before it by 1 - alpha: a geometric series. Colors and opacities
    # of the cloud are float32 in either case, and unity's edge takes off 1e-5 of alpha, which changes neighbors' shares.
    least = alphas[alphas > 0].min()
    bound = (16 * HALF_STEP if dtype == "float64" else 24 * HALF_STEP / least) + (1e-5 if model == "unity" else 0.0)
    assert np.abs(found.image - image).max() <= bound
    assert np.abs(found.alphas - covered).max() <= bound
    assert found.counts.drawn == LAYERS


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_blending__of_layers_that_all_count_is_exact(dtype: Any) -> None:
    # Compensation makes visionary's layers of 0.021 as thin as 2e-5, and it has no floor: the last of 100,000 still shows.
    rules = RULES["visionary"]
    depths = np.linspace(5.5, 6.0, LAYERS)
    means = np.stack([np.zeros(LAYERS), np.zeros(LAYERS), depths], axis=1)
    colors = np.linspace(0.0, 1.0, LAYERS)[:, None] * [1.0, 0.5, 0.25]
    size, opacity = 0.002, 0.021
    cloud = splats(means, scales=size, opacities=opacity, colors=colors)

    found = render(cloud, camera(SIDE, SIDE, near=0.2, far=10.0), model="visionary", variant="float", dtype=dtype)

    alphas = layer_alphas(rules, size, opacity, cloud.means[:, 2].astype(np.float64))
    image, covered = composite(alphas, colors)
    middle = slice(1, 3)
    assert 0.05 < 1 - covered[1, 1] < 0.5
    # A product of n factors: each of them, 1 - alpha, is rounded, and so are the products.
    bound = 2 * LAYERS * HALF_STEP if dtype == "float32" else 64 * HALF_STEP
    assert np.abs(found.alphas[middle, middle] - covered[middle, middle]).max() <= bound
    assert np.abs(found.image[middle, middle] - image[middle, middle]).max() <= bound


def test_blending__front_to_back_multiplies_transmittance_exactly() -> None:
    count, opacity = LAYERS, 0.005
    depths = np.linspace(5.0, 6.0, count)
    cloud = splats(np.stack([np.zeros(count), np.zeros(count), depths], axis=1), scales=500.0, opacities=opacity, colors=1.0)

    rendering = render(cloud, camera(width=2, height=2), model="inria")

    # Drawing stops before the transmittance falls below 1e-4: the exact power of the last layer drawn.
    alpha = float(activations.sigmoid(cloud.opacity_logits)[0])
    layers = int(np.floor(np.log(1e-4) / np.log1p(-alpha)))
    exact = float((1 - MP.mpf(alpha)) ** layers)
    # Every product rounds 1 - alpha and itself, and the Gaussian falls by 1e-5 over two pixels.
    assert 1 - rendering.alphas == pytest.approx(np.full((2, 2), exact), rel=4 * layers * HALF_STEP + layers * opacity * 2e-5)
    assert rendering.image == pytest.approx(rendering.alphas[:, :, None] * np.ones(3), abs=layers * HALF_STEP)


# -- chains of changes


def test_label_deltas__do_not_drift_over_ten_thousand_frames(rng: np.random.Generator) -> None:
    frames, count = 10_000, 50
    labels = [rng.integers(0, 1000, count).astype(np.uint16)]
    for _ in range(frames - 1):
        moved = rng.random(count) < 0.05
        labels.append(np.where(moved, rng.integers(0, 1000, count), labels[-1]).astype(np.uint16))
    segment = DeltaSegment(field="d", start_frame=0, frame_count=frames, splat_count=count, label_count=1000)
    blocks = [changes(before, after) for before, after in pairwise(labels)]
    data = write_delta(segment, blocks, magic=b"SPL4DLB1")

    found, issues = read_delta(data, segment)

    assert issues == []
    current = labels[0].copy()
    for block, expected in zip(found, labels[1:], strict=True):
        assert block.dtype == UPDATE
        current[block["splat"]] = block["label"]
        assert np.array_equal(current, expected)


def test_sog4d__does_not_drift_over_a_thousand_frames(rng: np.random.Generator) -> None:
    """The whole way through a bundle: one segment, so that every label of the last frame is the sum of all changes."""
    frames, count, period = 1_000, 4, 7
    base = random_cloud(count, sh_degree=1)
    poses = [
        base.replace(
            log_scales=base.log_scales + rng.normal(0, 0.3, (count, 3)),
            quats=rng.normal(size=(count, 4)),
            shN=base.shN + rng.normal(0, 0.2, base.shN.shape),
        )
        for _ in range(period)
    ]

    def frame(index: int) -> GaussianCloud:
        # The last frame is the first one again, after changes in all that lie between.
        if index == frames - 1:
            return poses[0]
        return poses[index % period].replace(means=base.means + np.float32(0.01 * index))

    sequence = GaussianSequence(frame, num_splats=count, sh_degree=1, num_frames=frames)
    record = FORMATS["sog4d"]
    assert record.write is not None
    assert record.read is not None
    assert record.bounds is not None
    stream = io.BytesIO()

    options = record.write_options(labels="delta-v1", delta_segment_length=frames, webp_effort=0, keep_tolerance=0.0)
    record.write(sequence, stream, options)
    stream.seek(0)
    decoded = record.read(stream, record.read_options())

    assert isinstance(decoded, GaussianSequence)
    assert record.inspect(stream).encoding["palettes"]["shN"]["segments"] == 1
    first, last = decoded.frame(0), decoded.frame(frames - 1)
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh0", "shN"):
        assert np.array_equal(getattr(first, name), getattr(last, name)), name
    bounds = record.bounds(poses[0], stream, 0)
    errors = attribute_errors(poses[0], last)
    for name in bounds:
        assert (errors[name] <= bounds[name]).all(), name
    # And every frame between is as near to its source as the first is: a code of a moving range, and labels.
    for index in rng.choice(frames, 5):
        errors = attribute_errors(frame(index), decoded.frame(int(index)))
        for name, limit in record.bounds(frame(index), stream, int(index)).items():
            assert (errors[name] <= limit).all(), (name, index)
