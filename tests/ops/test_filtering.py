"""Which splats are invalid, under which cause, and how many."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.ops.filtering import CAUSES, classify_invalid, drop_invalid, prune_opacity, refuse_invalid
from gsplat_tools.parallel import use_jobs

ALWAYS_LEGAL = {("log_scales", -np.inf), ("opacity_logits", np.inf), ("opacity_logits", -np.inf)}


def make_cloud(count: int = 6, *, has_motion: bool = False, num_rest: int = 3) -> GaussianCloud:
    one = lambda *shape: np.ones((count, *shape), np.float32)  # noqa: E731
    motion = {"velocities": one(3), "times": one(), "durations": one()} if has_motion else {}
    return GaussianCloud(one(3), one(3), one(4), one(), one(3), one(num_rest, 3), **motion)


def with_values(cloud: GaussianCloud, changes) -> GaussianCloud:
    """Set (attribute, splat, column) to a value."""
    arrays = {name: values.copy() for name, values in cloud.arrays().items()}
    for name, splat, column, value in changes:
        arrays[name].reshape(len(cloud), -1)[splat, column] = value
    return cloud.replace(**arrays)


@pytest.mark.parametrize("value", [np.nan, -np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", list(make_cloud(has_motion=True).arrays()))
def test_classify_invalid__knows_which_infinities_are_legal(name, value):
    kind = "nan" if np.isnan(value) else "inf"
    width = make_cloud(has_motion=True).arrays()[name].reshape(6, -1).shape[1]

    for column in range(width):
        keeps, dropped = classify_invalid(with_values(make_cloud(has_motion=True), [(name, 4, column, value)]))

        if (name, value) in ALWAYS_LEGAL:
            assert keeps.all()
            assert dropped == {}
        else:
            assert dropped == {f"{name}-{kind}": 1}
            np.testing.assert_array_equal(keeps, [True, True, True, True, False, True])


@pytest.mark.parametrize("value", [3.4028235e38, -3.4028235e38, 1e-45, -0.0])
def test_classify_invalid__keeps_the_ends_of_what_is_finite(value):
    changes = [(name, 0, 0, value) for name in make_cloud(has_motion=True).arrays()]

    assert classify_invalid(with_values(make_cloud(has_motion=True), changes))[1] == {}


def test_classify_invalid__takes_only_exact_zeros_for_a_zero_quaternion():
    zero = [("quats", 1, i, (-0.0, 0.0)[i % 2]) for i in range(4)]
    tiny = [("quats", 2, i, 0.0) for i in range(3)] + [("quats", 2, 3, 1e-45)]

    keeps, dropped = classify_invalid(with_values(make_cloud(), zero + tiny))

    assert dropped == {"quats-zero": 1}
    assert not keeps[1]
    assert keeps[2]


def test_classify_invalid__counts_a_splat_under_its_first_cause():
    changes = [
        ("means", 0, 1, np.inf), ("means", 0, 2, np.nan), ("quats", 0, 0, np.nan),
        ("log_scales", 1, 0, np.inf), ("sh0", 1, 0, np.nan),
        ("quats", 3, 0, np.inf), ("shN", 3, 8, np.inf),
        ("shN", 4, 8, np.inf), ("opacity_logits", 4, 0, np.inf),
    ]  # fmt: skip

    keeps, dropped = classify_invalid(with_values(make_cloud(), changes))

    assert list(dropped.items()) == [("means-nan", 1), ("log_scales-inf", 1), ("quats-inf", 1), ("shN-inf", 1)]
    np.testing.assert_array_equal(keeps, [False, False, True, False, False, True])


def oracle(cloud: GaussianCloud) -> list[str | None]:
    """First cause of each splat, said in plain numpy."""
    causes: list[str | None] = []
    for splat in range(len(cloud)):
        found = None
        for name, values in cloud.arrays().items():
            row = values[splat].ravel()
            illegal = {"opacity_logits": [], "log_scales": [np.inf]}.get(name, [np.inf, -np.inf])
            tests = [
                ("nan", np.isnan(row).any()),
                ("inf", np.isin(row, illegal).any()),
                ("zero", name == "quats" and not row.any()),
            ]
            found = found or next((f"{name}-{kind}" for kind, is_bad in tests if is_bad), None)
        causes.append(found)
    return causes


@settings(deadline=None, max_examples=60)
@given(
    changes=st.lists(
        st.tuples(
            st.sampled_from(
                ["means", "log_scales", "quats", "opacity_logits", "sh0", "shN", "velocities", "times", "durations"]
            ),
            st.integers(0, 9),
            st.integers(0, 8),
            st.sampled_from([np.nan, np.inf, -np.inf, 0.0]),
        ),
        max_size=30,
    )
)
def test_classify_invalid__agrees_with_plain_numpy(changes):
    cloud = make_cloud(10, has_motion=True)
    widths = {name: values[0].size for name, values in cloud.arrays().items()}
    cloud = with_values(cloud, [(name, splat, column % widths[name], value) for name, splat, column, value in changes])
    expected = oracle(cloud)

    keeps, dropped = classify_invalid(cloud)

    np.testing.assert_array_equal(keeps, [cause is None for cause in expected])
    assert dropped == {cause: expected.count(cause) for cause in CAUSES if cause in expected}


def test_classify_invalid__looks_at_every_block():
    count = 70_000
    splats = [0, 16_383, 16_384, 50_000, 69_999]
    cloud = with_values(make_cloud(count, num_rest=0), [("sh0", splat, 2, np.nan) for splat in splats])

    for jobs in (1, 3):
        with use_jobs(jobs):
            keeps, dropped = classify_invalid(cloud)
        np.testing.assert_array_equal(np.flatnonzero(~keeps), splats)
        assert dropped == {"sh0-nan": 5}


def test_drop_invalid__keeps_order_and_everything_else():
    cloud = with_values(make_cloud(4), [("means", i, 0, i) for i in range(4)] + [("sh0", 2, 0, np.nan)])
    cloud = cloud.replace(extra={"id": np.arange(4)}, origin=(1, 2, 3))

    kept, dropped = drop_invalid(cloud)

    assert dropped == {"sh0-nan": 1}
    np.testing.assert_array_equal(kept.extra["id"], [0, 1, 3])
    np.testing.assert_array_equal(kept.means[:, 0], [0, 1, 3])
    np.testing.assert_array_equal(kept.origin, [1, 2, 3])


def test_drop_invalid__returns_the_same_cloud_where_all_are_valid():
    for count in (0, 5):
        cloud = make_cloud(count)
        kept, dropped = drop_invalid(cloud)
        assert kept is cloud
        assert dropped == {}


def test_refuse_invalid__gives_counts_and_the_first():
    refuse_invalid(make_cloud())
    cloud = with_values(make_cloud(), [("quats", 5, 0, np.nan), ("log_scales", 3, 0, np.inf), ("quats", 4, 0, np.nan)])

    with pytest.raises(
        CloudError, match=r"3 of 6 splats are invalid: log_scales-inf 1, quats-nan 2; the first is splat 3"
    ) as caught:
        refuse_invalid(cloud)

    assert caught.value.field == "log_scales"


def test_prune_opacity__drops_what_is_below():
    # The sigmoid of 0 is exactly 0.5.
    cloud = make_cloud(6).replace(opacity_logits=np.array([0.0, -1e-3, 1e-3, -np.inf, np.inf, np.nan], np.float32))

    kept, count = prune_opacity(cloud, 0.5)

    assert count == 2
    np.testing.assert_array_equal(kept.opacity_logits, np.array([0.0, 1e-3, np.inf, np.nan], np.float32))
    assert prune_opacity(cloud, 0)[0] is cloud
    for threshold in (-0.1, 1.5, np.nan):
        with pytest.raises(ValueError, match="opacity threshold"):
            prune_opacity(cloud, threshold)
