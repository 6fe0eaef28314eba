"""Visionary's preprocess pass against an oracle of matrices in float64, and against the picture of its model.

A number rounded to half is off by at most 2^-11 of it, or 2^-25 where halves are subnormal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.parallel import use_jobs
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.visionary import KEYS_PER_BLOCK, RECORD, count_frame, preprocess, sort_records
from tests.clouds import random_cloud
from tests.oracles import oracle_projection, scenes, visionary
from tests.reference import splats as hand

HALF, HALF_SUBNORMAL = 2.0**-11, 2.0**-25
TURNED = np.array([[0, -0.5, 0, 0.3], [0.5, 0, 0, -0.1], [0, 0, 0.5, 0.2], [0, 0, 0, 1]])

OPTIONS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "kernel_size": {"kernel_size": 0.3},
    "no kernel": {"kernel_size": 0.0},
    "sh_degree 0": {"sh_degree": 0},
    "sh_degree 2": {"sh_degree": 2},
    "raw color": {"raw_color": True},
    "raw color f16": {"raw_color": True, "precision": "f16"},
    "f16": {"precision": "f16"},
    "trace": {"max_world_trace": 0.05},
    "scaling": {"gaussian_scaling": 1.7},
    "opacity": {"opacity_scale": 0.1},
    "cutoff": {"cutoff_scale": 0.5},
    "normal": {"render_mode": "normal"},
    "depth": {"render_mode": "depth"},
    "no mip": {"mip": False},
    "model": {"model_matrix": TURNED},
    "model, trace": {"model_matrix": TURNED, "max_world_trace": 0.02},
}


def _camera(camera: oracle_projection.Camera) -> Camera:
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return Camera(camera.viewmat, K, camera.width, camera.height, camera.near, camera.far)


def _check(scene: dict[str, Any], camera: oracle_projection.Camera, dtype: str, **options: Any) -> int:
    """Hold all records against the oracle; return how many there were."""
    expected, margins = visionary.preprocess(scene, camera, **options)
    found = preprocess(GaussianCloud(**scene), _camera(camera), dtype=dtype, **options)
    close = 1e-9 if dtype == "float64" else 1e-4
    eps = 1e-12 if dtype == "float64" else 1e-5
    rows = {int(splat): row for row, splat in enumerate(found.splat_ids)}
    is_clear = margins > close
    assert is_clear.mean() > 0.95
    assert set(rows) ^ {record["splat"] for record in expected} <= set(np.flatnonzero(~is_clear))
    for record in expected:
        if not is_clear[record["splat"]]:
            continue
        row = found.records[rows[record["splat"]]]

        def near(name: str, value: Any, extra: float, row: Any = row) -> None:
            value = np.asarray(value)
            bound = np.maximum(np.abs(value) * HALF, HALF_SUBNORMAL) + extra
            assert (np.abs(row[name].astype(np.float64) - value) <= bound).all(), name

        scale = float(max(np.abs(record["v_0"]).max(), np.abs(record["v_1"]).max()))
        # An eigenvector turns by the error of the covariance over the gap of the eigenvalues.
        turn = eps / max(record["gap"], eps)
        if turn < 1e-2:
            near("v_0", record["v_0"], scale * (turn + eps))
            near("v_1", record["v_1"], scale * (turn + np.sqrt(eps) * (dtype == "float32") + eps))
        near("pos", record["pos"], 4 * eps)
        assert abs(row["posz"] - record["posz"]) <= 2.0**-23 + eps
        # Normals by power iteration are as good as the inverse of the covariance, in float32 not at all for flat splats.
        if options.get("render_mode") != "normal" or dtype == "float64":
            color_eps = 1e-6 if options.get("render_mode") == "normal" else 16 * eps
            near("color_0", record["color"][:2], color_eps * (1 + np.abs(record["color"]).max()))
            near("color_1", [record["color"][2], row["color_1"][1]], color_eps * (1 + np.abs(record["color"]).max()))
        # The determinant loses eps times its terms; its root loses as much over twice the root.
        lost = eps * record["det_ratio_scale"]
        opacity_error = (
            record["full_opacity"] * min(np.sqrt(lost), lost / max(record["coef"], 1e-30)) if options.get("mip", True) else 0
        )
        near("color_1", [row["color_1"][0], record["opacity"]], opacity_error + eps)
        key = found.keys[rows[record["splat"]]].view(np.float32)
        z_far_error = 0.0 if dtype == "float64" else camera.far * 2.0**-23 * camera.far / camera.near
        assert abs(key - record["key"]) <= 2.0**-22 * camera.far + z_far_error
    return len(expected)


@pytest.mark.parametrize("name", ["mixed", "needles", "discs", "isotropic", "tiny", "huge", "edges"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_preprocess__agrees_with_the_oracle(name: str, dtype: str) -> None:
    scene = scenes.as_float32(scenes.SCENES[name](1))

    assert _check(scene, scenes.camera(), dtype) > 0.05 * len(scene["means"])


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_preprocess__agrees_with_the_oracle_for_every_option(options: dict[str, Any], dtype: str) -> None:
    camera = scenes.camera(fx=50.0)
    camera.cx += 5.5
    camera.cy -= 3.25

    assert _check(scenes.as_float32(scenes.mixed(3)), camera, dtype, **options) > 10


@pytest.mark.parametrize("name", ["mixed", "isotropic", "needles", "edges"])
def test_records__draw_the_picture_of_the_model(name: str) -> None:
    scene, view = GaussianCloud(**scenes.as_float32(scenes.SCENES[name](5))), _camera(scenes.camera())

    found = preprocess(scene, view, dtype="float64")
    _, order = sort_records(found)
    image, alphas = visionary.draw(found.records, order, view.width, view.height)
    expected = render(scene, view, model="visionary", dtype="float64")

    assert expected.alphas.max() > 0.3
    # Covariances of float32 move a few numbers across a tie of their rounding to halves, hence the largest error.
    errors = np.maximum(np.abs(alphas - expected.alphas), np.abs(image - expected.image).max(axis=2))
    assert errors.max() < 5e-3
    assert np.median(errors) < 1e-6


def test_sort_records__pads_keys_and_orders_back_to_front() -> None:
    cloud = hand.splats([[0, 0, 2], [0, 0, 5], [0, 0, 3], [0, 0, 5]])

    found = preprocess(cloud, hand.camera())
    keys, payload = sort_records(found)

    assert payload.tolist() == [1, 3, 2, 0]
    assert len(keys) == found.counters.padded_size
    assert (keys[4:] == 0xFFFFFFFF).all()
    assert (np.diff(keys[:4].astype(np.int64)) >= 0).all()
    assert found.payload.tolist() == [0, 1, 2, 3]


def test_keys__are_the_bits_of_the_far_plane_less_clip_z() -> None:
    found = preprocess(hand.splats([0, 0, 2]), hand.camera(near=1.0, far=3.0))

    # P22 = 1.5, P32 = -1.5, so that zfar = 3 and clip z = 1.5 at z = 2: all exact.
    assert found.keys.view(np.float32).tolist() == [1.5]
    assert found.records["posz"].tolist() == [0.75]


@pytest.mark.parametrize(("count", "dispatch"), [(0, 0), (1, 2), (3840, 2), (3841, 3)])
def test_counters__of_visible_splats(count: int, dispatch: int) -> None:
    found = preprocess(hand.splats(np.tile([[0.0, 0.0, 2.0]], (count, 1)).reshape(count, 3)), hand.camera())

    assert len(found.records) == len(found.keys) == count
    assert found.counters.sort_infos.tolist() == [count, 326 * 3840, 4, 0, 1]
    assert found.counters.draw_indirect.tolist() == [4, count, 0, 0]
    assert found.counters.dispatch_indirect.tolist() == [dispatch, 1, 1]


def test_counters__of_culled_splats_keep_the_safety_workgroup() -> None:
    counters = preprocess(hand.splats([0, 0, -2]), hand.camera()).counters

    assert (counters.keys_size, counters.instance_count, counters.dispatch_x) == (0, 0, 1)


def test_count_frame__grows_capacity_by_a_quarter_over_the_total() -> None:
    assert count_frame(2_000_000, 7).padded_size == 652 * KEYS_PER_BLOCK
    with pytest.raises(ValueError, match="num_records"):
        count_frame(3, 4)


def test_record__is_24_bytes_in_the_order_of_the_shader() -> None:
    found = preprocess(hand.splats([0.1, -0.1, 2.0], colors=(0.75, 0.5, 0.25)), hand.camera(near=1.0, far=3.0), mip=False)

    words = found.records.view(np.uint32)
    halves = found.records.view(np.float16)
    assert RECORD.itemsize == 24
    assert words[3] == np.float32(found.records["posz"][0]).view(np.uint32)
    assert halves[[8, 9, 10, 11]].tolist() == [0.75, 0.5, 0.25, 0.5]
    # Half an image is 0.64 and 0.48 units wide at a depth of 2; y is up.
    assert halves[[4, 5]] == pytest.approx([0.1 / 0.64, 0.1 / 0.48], rel=2**-11)


def test_zero_eigenvector__is_counted_and_lies_along_x() -> None:
    found = preprocess(hand.splats([0, 0, 2]), hand.camera())

    # sigma = 100 / 2 * 0.05 = 2.5 px; lambda = 6.25 + 0.1.
    axis = np.sqrt(2 * 6.35)
    assert found.undefined_eigenvectors == 1
    assert found.records["v_0"][0] == pytest.approx([axis / 64, 0], rel=2**-11)
    assert found.records["v_1"][0] == pytest.approx([0, -axis / 48], rel=2**-11)


@pytest.mark.parametrize(("variance", "is_seen"), [(0.0, False), (0.99e-3, False), (1.01e-3, True)])
def test_mip__makes_splats_of_a_tiny_determinant_transparent_but_stores_them(variance: float, is_seen: bool) -> None:
    scale = np.sqrt(variance) * 2 / hand.FOCAL

    found = preprocess(hand.splats([0, 0, 2], scales=scale, opacities=0.5), hand.camera())

    det, blurred = variance**2, (variance + 0.1) ** 2
    expected = 0.5 * np.sqrt(det / (blurred + 1e-6) + 1e-6) if is_seen else 0.0
    assert found.counters.keys_size == 1
    assert found.records["color_1"][0, 1] == pytest.approx(expected, rel=1e-3)


def test_mip__is_on_by_default_and_its_option_turns_it_off() -> None:
    cloud, view = hand.splats([0, 0, 2], opacities=0.5), hand.camera()

    compensated = 0.5 * np.sqrt(6.25**2 / (6.35**2 + 1e-6) + 1e-6)
    assert preprocess(cloud, view).records["color_1"][0, 1] == pytest.approx(compensated, rel=2**-11)
    assert preprocess(cloud, view, mip=False).records["color_1"][0, 1] == 0.5


def test_cull__keeps_what_lies_between_the_planes_and_within_a_fifth_beyond_the_frame() -> None:
    depths = [-2.0, 0.0, 0.499, 0.501, 9.99, 10.01]
    edges = [[0.32 * 1.199, 0], [0.32 * 1.201, 0], [0, -0.24 * 1.199], [0, -0.24 * 1.201]]
    means = [[0, 0, z] for z in depths] + [[x, y, 1.0] for x, y in edges]

    found = preprocess(hand.splats(means), hand.camera(near=0.5, far=10.0))

    assert found.splat_ids.tolist() == [3, 4, 6, 8]
    assert (found.culled, found.invalid) == (6, 0)


def test_near_plane__axes_are_not_limited_there() -> None:
    found = preprocess(hand.splats([0, 0, 0.011], scales=0.05), hand.camera(near=0.01))

    sigma = hand.FOCAL / 0.011 * 0.05
    assert found.records["v_0"][0, 0] == pytest.approx(np.sqrt(2 * (sigma**2 + 0.1)) / 64, rel=2**-10)


def test_opacity_cull__comes_after_the_scale_and_before_the_compensation() -> None:
    cloud, view = hand.splats([[0, 0, 2]] * 2, opacities=[0.0201, 0.0199], scales=0.001), hand.camera()

    assert preprocess(cloud, view).splat_ids.tolist() == [0]
    assert len(preprocess(cloud, view, opacity_scale=1.1).records) == 2
    assert len(preprocess(cloud, view, opacity_scale=0.9).records) == 0
    assert preprocess(cloud, view).records["color_1"][0, 1] < 0.001


def test_max_world_trace__drops_only_where_it_is_asked_for() -> None:
    cloud, view = hand.splats([[0, 0, 500.0]] * 2, scales=[40.0, 4.0]), hand.camera()

    assert len(preprocess(cloud, view).records) == 2
    assert preprocess(cloud, view, max_world_trace=1000.0000002).splat_ids.tolist() == [1]


def test_f16__loses_small_covariances_and_overflows_large_ones() -> None:
    # 1e-4 squared is below 2^-25, 300 squared above 65519.
    cloud, view = hand.splats([[0, 0, 2.0], [0, 0, 2.0], [0, 0, 900.0]], scales=[1e-4, 0.05, 300.0]), hand.camera()

    single, half = preprocess(cloud, view, mip=False), preprocess(cloud, view, precision="f16")

    assert len(single.records) == 3
    assert half.splat_ids.tolist() == [0, 1]
    assert half.records["color_1"][:, 1].tolist()[0] == 0.0
    assert half.invalid == 1


def test_invalid_splats__are_left_out_and_counted() -> None:
    cloud = hand.splats([[0, 0, 2.0]] * 6)
    broken = {name: values.copy() for name, values in cloud.arrays().items()}
    broken["quats"][5] = 0
    broken["means"][0, 0] = np.nan
    broken["log_scales"][1, 0] = np.inf
    broken["opacity_logits"][2] = np.nan
    broken["sh0"][3, 1] = -np.inf

    found = preprocess(GaussianCloud(**broken), hand.camera())

    assert found.splat_ids.tolist() == [4]
    assert found.invalid == 5


def test_channel_major__gives_the_records_of_interleaved() -> None:
    cloud, view = random_cloud(300), _camera(scenes.camera())

    for degree in range(4):
        usual = preprocess(cloud, view, sh_degree=degree)
        other = preprocess(cloud, view, sh_degree=degree, sh_layout="channel-major")
        assert usual.records.tobytes() == other.records.tobytes()
    assert preprocess(cloud, view, sh_degree=0).records.tobytes() != usual.records.tobytes()


def test_normals__of_flat_splats_are_their_flat_axis() -> None:
    turned = np.sqrt(0.5)
    cloud = hand.splats(
        [[0, 0, 2.0]] * 3,
        scales=[[0.1, 0.2, 0.01]] * 3,
        quats=[(1, 0, 0, 0), (turned, turned, 0, 0), (turned, 0, -turned, 0)],
    )

    found = preprocess(cloud, hand.camera(), render_mode="normal")

    colors = np.concatenate([found.records["color_0"], found.records["color_1"][:, :1]], axis=1)
    assert colors == pytest.approx(np.array([[0.5, 0.5, 1], [0.5, 1, 0.5], [1, 0.5, 0.5]]), abs=2e-3)


def test_normals__of_splats_without_thickness_are_their_flat_axis() -> None:
    found = preprocess(hand.splats([0, 0, 2.0], scales=[[0.0, 0.1, 0.2]]), hand.camera(), render_mode="normal")

    # The determinant is 0: 1e-12 stands for it.
    assert [*found.records["color_0"][0], found.records["color_1"][0, 0]] == [1.0, 0.5, 0.5]


def test_normals__of_points_are_the_default() -> None:
    found = preprocess(hand.splats([0, 0, 2.0], scales=0.0), hand.camera(), render_mode="normal")

    assert [*found.records["color_0"][0], found.records["color_1"][0, 0]] == [0.5, 0.5, 1.0]


def test_origin__costs_no_precision() -> None:
    cloud, view = random_cloud(200), scenes.camera()
    far = np.array([1e6, -2e6, 3e6])
    moved = scenes.camera()
    moved.viewmat[:3, 3] -= moved.rotation @ far

    here = preprocess(cloud, _camera(view)).records
    there = preprocess(cloud.replace(origin=far), _camera(moved)).records

    assert len(here) == len(there)
    assert np.abs(here["posz"] - there["posz"]).max() < 1e-6


def test_preprocess__has_the_same_bits_for_any_number_of_threads() -> None:
    cloud, view = random_cloud(40_000, sh_degree=1), _camera(scenes.camera())
    with use_jobs(1):
        one = preprocess(cloud, view)
    with use_jobs(3):
        three = preprocess(cloud, view)

    assert one.records.tobytes() == three.records.tobytes()
    assert np.array_equal(one.keys, three.keys)
    assert np.array_equal(one.splat_ids, three.splat_ids)


@pytest.mark.parametrize(
    "options",
    [
        {"kernel_size": -0.1},
        {"cutoff_scale": 0.05},
        {"opacity_scale": np.nan},
        {"gaussian_scaling": np.inf},
        {"sh_degree": 4},
        {"sh_layout": "planar"},
        {"precision": "i8"},
        {"render_mode": "wireframe"},
        {"dtype": "float16"},
        {"max_world_trace": np.nan},
        {"model_matrix": np.eye(3)},
    ],
    ids=str,
)
def test_preprocess__refuses_what_no_option_means(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        preprocess(random_cloud(1), hand.camera(), **options)
