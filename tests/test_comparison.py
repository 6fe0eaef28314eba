import numpy as np
import pytest

from gsplat_tools.attributes import quaternions
from gsplat_tools.chunks import as_chunks
from gsplat_tools.comparison import AttributeTally, attribute_errors, compare, match_splats, paired, sample
from gsplat_tools.errors import CloudError
from gsplat_tools.ops.coordinates import convert_coordinates
from tests.clouds import random_cloud


def relabeled(count: int = 50):  # type: ignore[no-untyped-def]
    """The same Gaussians with their axes turned by 90 degrees about the local z axis."""
    cloud = random_cloud(count, sh_degree=0)
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    quats = quaternions.multiply(cloud.quats.astype(np.float64), np.tile(quarter, (count, 1)))
    return cloud, cloud.replace(quats=quats, log_scales=cloud.log_scales[:, [1, 0, 2]])


def test_attribute_errors__do_not_see_relabeled_axes() -> None:
    cloud, turned = relabeled()

    errors = attribute_errors(cloud, turned)

    assert not np.array_equal(cloud.quats, turned.quats)
    assert errors["scales"].max() == 0
    assert errors["covariances"].max() < 1e-6


def test_attribute_errors__see_axes_that_are_relabeled_without_the_rotation() -> None:
    cloud, turned = relabeled()

    errors = attribute_errors(cloud, cloud.replace(log_scales=turned.log_scales))

    assert np.median(errors["covariances"]) > 0.1


def test_attribute_errors__of_a_doubled_scale_is_three_quarters_of_the_new_covariance() -> None:
    cloud = random_cloud(5, sh_degree=0)

    errors = attribute_errors(cloud, cloud.replace(log_scales=cloud.log_scales + np.float32(np.log(2))))

    assert np.allclose(errors["covariances"], 3.0, rtol=1e-5)
    assert np.allclose(errors["scales"], np.log(2), atol=1e-6)


def test_attribute_errors__count_missing_bands_as_zero() -> None:
    cloud = random_cloud(5, sh_degree=2)

    errors = attribute_errors(cloud, cloud.replace(shN=cloud.shN[:, :3]))

    assert errors["shN"][:, :3].max() == 0
    assert np.array_equal(errors["shN"][:, 3:], np.abs(cloud.shN[:, 3:].astype(np.float64)))


def test_attribute_errors__compare_world_positions() -> None:
    cloud = random_cloud(5)
    moved = cloud.replace(means=cloud.means - np.float32(2), origin=np.full(3, 2.0))

    assert attribute_errors(cloud, moved)["means"].max() < 1e-6


def test_attribute_errors__survive_flat_axes_and_huge_scales() -> None:
    cloud = random_cloud(2, sh_degree=0)
    cloud = cloud.replace(log_scales=np.array([[-np.inf, 0, 0], [80, 0, -90]]), opacity_logits=np.array([np.inf, -np.inf]))

    errors = attribute_errors(cloud, cloud)

    assert all(values.max(initial=0) == 0 for values in errors.values())


def test_attribute_errors__refuse_different_lengths() -> None:
    with pytest.raises(CloudError, match="3 splats, the candidate 2"):
        attribute_errors(random_cloud(3), random_cloud(2))


def test_tally__counts_values_beyond_their_own_bound() -> None:
    cloud = random_cloud(10, sh_degree=0)
    means = cloud.means.copy()
    means[3, 1] += 0.5
    tally = AttributeTally()

    tally.add(cloud, cloud.replace(means=means), {"means": np.full(3, 0.1)})

    assert tally.attributes["means"].exceeded == 1
    assert tally.attributes["means"].bound == pytest.approx(0.1)
    assert "means: 1 of 30 values beyond their bound" in tally.exceeded()[0]


def test_tally__is_the_same_in_pieces() -> None:
    cloud, other = random_cloud(100, seed=1), random_cloud(100, seed=2)
    whole, pieces = AttributeTally(), AttributeTally()

    whole.add(cloud, other)
    for a, b in paired(as_chunks(cloud, 7), as_chunks(other, 11)):
        pieces.add(a, b)

    for name, entry in whole.to_json().items():
        assert pieces.to_json()[name] == pytest.approx(entry), name


def test_match_splats__finds_a_morton_order() -> None:
    from gsplat_tools.ops.ordering import splat_order

    cloud = random_cloud(500)
    shuffled = cloud.take(splat_order(cloud, "morton"))

    matched = match_splats(cloud, shuffled)

    assert matched is not None
    assert np.array_equal(shuffled.take(matched).means, cloud.means)
    assert match_splats(cloud, cloud.replace(means=cloud.means + np.float32(5))) is None
    assert match_splats(cloud, cloud.take(slice(0, 10))) is None


def test_sample__takes_every_kth_splat_across_chunks() -> None:
    cloud = random_cloud(1000, sh_degree=0)

    thinned = sample(as_chunks(cloud, 64), 250)

    assert np.array_equal(thinned.means, cloud.means[::4])


def test_compare__brings_the_candidate_into_the_axes_of_the_reference() -> None:
    reference = random_cloud(200, sh_degree=2).replace(coordinate_system="RDF")

    report = compare(reference, convert_coordinates(reference, "RUF"), views=2, size=(96, 64))

    assert report.psnr_min is None or report.psnr_min > 90
    assert report.attributes["means"]["max"] == 0
