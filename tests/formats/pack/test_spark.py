import base64
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats.pack import limits, spark, words
from gsplat_tools.parallel import use_jobs
from tests.formats.pack.clouds import make_cloud, relative_covariance_errors
from tests.oracles import spark_layout

FIXTURES = Path(__file__).parents[3] / "fixtures" / "spark"


def golden(name, dtypes):
    """A fixture with its base64 texts as arrays."""

    def arrays(value, key=""):
        if isinstance(value, dict):
            return {k: arrays(v, k) for k, v in value.items()}
        return np.frombuffer(base64.b64decode(value), dtypes(key)) if isinstance(value, str) else value

    content = json.loads((FIXTURES / name).read_text())
    return content | {key: arrays(content[key]) for key in ("inputs", "packed", "words", "decoded") if key in content}


def encoding_of(content, name):
    return spark.SplatEncoding.from_json(content["encodings"][name])


@pytest.mark.parametrize("name", ["default", "custom"])
def test_encode_values__has_the_bits_of_the_original_encoder(name):
    content = golden("splats.json", lambda key: "<u4" if key in ("default", "custom") else "<f4")
    given_values = {key: values.reshape(content["count"], -1) for key, values in content["inputs"].items()}

    packed = spark.encode_values(
        given_values["center"],
        given_values["scales"],
        given_values["quat"][:, [3, 0, 1, 2]],
        given_values["opacity"][:, 0],
        given_values["rgb"],
        encoding_of(content, name),
    )

    np.testing.assert_array_equal(packed, content["packed"][name].reshape(-1, 4))


@pytest.mark.parametrize("name", ["default", "custom"])
@pytest.mark.parametrize("band", [1, 2, 3])
def test_encode_band__has_the_bits_of_the_original_encoder(name, band):
    content = golden("sh.json", lambda key: "<f4")
    words_of = golden("sh.json", lambda key: "<u4")["words"][name][f"sh{band}"]
    values = np.ascontiguousarray(content["inputs"][f"sh{band}"].reshape(content["count"], -1), np.float32)
    packed = np.zeros((content["count"], 2 if band == 1 else 4), np.uint32)

    words.encode_band(values, 0, band, encoding_of(content, name), packed, np.zeros(2, np.int64))

    np.testing.assert_array_equal(packed, words_of.reshape(packed.shape))


@pytest.mark.parametrize("name", ["default", "custom"])
def test_decode__returns_what_the_original_decoder_returns(name):
    packed = golden("splats.json", lambda key: "<u4")["packed"][name].reshape(-1, 4)
    content = golden("decoded.json", lambda key: "<f4")
    expected = {key: values.reshape(len(packed), -1) for key, values in content["decoded"][name].items()}

    cloud = spark.decode(spark.SparkPack(packed=packed, encoding=encoding_of(content, name)))

    np.testing.assert_array_equal(cloud.means, expected["center"])
    np.testing.assert_allclose(np.exp(cloud.log_scales), expected["scales"], rtol=2e-6, atol=1e-30)
    np.testing.assert_allclose(cloud.quats[:, [1, 2, 3, 0]], expected["quat"], atol=1e-7)
    np.testing.assert_allclose(1 / (1 + np.exp(-cloud.opacity_logits.astype(float))), expected["opacity"][:, 0], atol=1e-7)
    np.testing.assert_allclose(cloud.sh0 * spark_layout.SH_C0 + 0.5, expected["rgb"], atol=1e-6)


def special_cloud(seed):
    """Edge values mixed: flat axes, opaque and absent splats, quaternions of every length and sign, ties."""
    rng = np.random.default_rng(seed)
    count = 700
    quats = rng.normal(size=(count, 4)) * np.exp(rng.uniform(-20, 20, (count, 1)))
    quats[: count // 3] = rng.choice([-1, -0.5, -0.0, 0, 0.5, 1, 1e-7], (count // 3, 4))
    return GaussianCloud(
        means=rng.choice([0, -0.0, 1e-8, 6.1e-5, 1 + 2**-11, 2049, -65519], (count, 3)),
        log_scales=rng.choice([-np.inf, -31, -30, -29.99, -12, -11.96, 0, 9, 9.05, 20], (count, 3)),
        quats=quats,
        opacity_logits=rng.choice([-np.inf, -800, -6.23, -6.2285, 0, 5.5, 7.5, np.inf, 0.0078431], count),
        sh0=rng.choice([-3, -1.7724539, -0.0, 0, 0.5, 1.7724539, 2], (count, 3)),
        shN=rng.choice([0, 0.5 / 63, -0.5 / 63, 1.5 / 127, 0.5 / 31, -0.5 / 7, 0.5, -1, 1.5], (count, 24, 3)),
    )


OTHER_RANGES = spark.SplatEncoding(
    rgb_min=-0.3, rgb_max=1.7, ln_scale_min=-9.5, ln_scale_max=3.25, sh1_max=0.7, sh2_max=0.9, sh3_max=1.9, sh4_max=0.3
)


@pytest.mark.parametrize("encoding", [spark.SplatEncoding(), OTHER_RANGES], ids=["default", "other"])
@pytest.mark.parametrize("cloud", [make_cloud(700, 4), special_cloud(1)], ids=["ordinary", "special"])
@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.LossyConversionWarning")
def test_encode__has_the_bits_of_plain_arithmetic(cloud, encoding):
    pack = spark.encode(cloud, encoding=encoding)

    ranges = {"rgb": (encoding.rgb_min, encoding.rgb_max), "ln": (encoding.ln_scale_min, encoding.ln_scale_max)}
    arrays = (cloud.means, cloud.log_scales, cloud.quats, cloud.opacity_logits, cloud.sh0)
    expected = [spark_layout.splat_words(*values, **ranges) for values in zip(*arrays, strict=True)]
    np.testing.assert_array_equal(pack.packed, np.array(expected, np.uint32))
    for band in range(1, 5):
        coefficients = cloud.shN[:, band * band - 1 : (band + 1) ** 2 - 1].reshape(len(cloud), -1)
        expected = [spark_layout.band_words(row, band, encoding.sh_max(band)) for row in coefficients]
        np.testing.assert_array_equal(getattr(pack, f"sh{band}"), np.array(expected, np.uint32))


def test_encode__finds_every_opacity_code_by_table_as_by_formula():
    edges = np.log(np.arange(0.5, 255)) - np.log(255 - np.arange(0.5, 255))
    near = edges[:, None] + np.linspace(-3e-6, 3e-6, 61)
    logits = np.concatenate([near.ravel(), np.linspace(-9, 9, 20_001), np.arange(-900, 901) / 128]).astype(np.float32)
    cloud = make_cloud(len(logits), 0).replace(opacity_logits=logits)

    codes = spark.encode(cloud).packed[:, 0] >> 24

    np.testing.assert_array_equal(codes, np.floor(255 / (1 + np.exp(-logits.astype(np.float64))) + 0.5))


def test_encode__finds_every_angle_code_by_table_as_by_formula():
    half = np.concatenate(
        [np.arange(0, 256) * np.pi / 510, (np.arange(255)[:, None] + 0.5 + np.linspace(-1e-5, 1e-5, 41)).ravel() * np.pi / 510]
    )
    quats = np.stack([np.cos(half), np.sin(half) * 0.6, np.sin(half) * -0.8, 0 * half], axis=1).astype(np.float32)
    cloud = make_cloud(len(quats), 0).replace(quats=quats)

    codes = spark.encode(cloud).packed[:, 3] >> 24

    np.testing.assert_array_equal(codes, [spark_layout.rotation_codes(*map(float, quat))[2] for quat in quats])


def angles_between(source, decoded):
    """Rotation angles modulo the 24 relabelings of axes, degrees."""
    from gsplat_tools.kernels.rotation_frames import FRAME_QUATS

    q = source.astype(np.float64) / np.linalg.norm(source.astype(np.float64), axis=1, keepdims=True)
    d = decoded.astype(np.float64)
    # conj(q) d is within a small turn of the frame; the largest |<frame, .>| is the cosine of half that turn.
    relative = np.stack(
        [
            (q * d).sum(1),
            q[:, 0] * d[:, 1] - q[:, 1] * d[:, 0] - (q[:, 2] * d[:, 3] - q[:, 3] * d[:, 2]),
            q[:, 0] * d[:, 2] - q[:, 2] * d[:, 0] - (q[:, 3] * d[:, 1] - q[:, 1] * d[:, 3]),
            q[:, 0] * d[:, 3] - q[:, 3] * d[:, 0] - (q[:, 1] * d[:, 2] - q[:, 2] * d[:, 1]),
        ],
        axis=1,
    )
    cosines = relative @ FRAME_QUATS.T
    nearest = (
        FRAME_QUATS[np.abs(cosines).argmax(axis=1)]
        * np.sign(cosines[np.arange(len(q)), np.abs(cosines).argmax(axis=1)])[:, None]
    )
    return np.rad2deg(4 * np.arcsin(np.linalg.norm(relative - nearest, axis=1) / 2))


def packed_in_frames(cloud, frames):
    """Reference words of a cloud whose splats were relabeled beforehand."""
    from gsplat_tools.kernels.rotation_frames import apply_frames

    quats, log_scales = np.empty_like(cloud.quats), np.empty_like(cloud.log_scales)
    apply_frames(cloud.quats, cloud.log_scales, frames, quats, log_scales)
    return spark.decode(spark.encode(cloud.replace(quats=quats, log_scales=log_scales)))


def test_encode__best_has_the_smallest_covariance_error_of_all_frames():
    cloud = make_cloud(3000, 1)
    errors = np.array(
        [relative_covariance_errors(cloud, packed_in_frames(cloud, np.full(3000, f, np.uint8))) for f in range(24)]
    )

    pack = spark.encode(cloud, rotation="best")

    found = relative_covariance_errors(cloud, spark.decode(pack))
    assert (found <= errors.min(axis=0) * 1.002 + 1e-6).all()  # the search is in float32 and second order
    assert found.mean() < errors[0].mean()
    np.testing.assert_array_equal(pack.sh1, spark.encode(cloud).sh1)


def test_choose_frames__by_angle_errs_little_over_uniform_rotations():
    from gsplat_tools.kernels import spark_frames

    cloud = make_cloud(30_000, 0)
    frames = np.empty(len(cloud), np.uint8)
    spark_frames.choose_frames(cloud.quats, cloud.log_scales, -12.0, 254 / 21, True, frames)

    found = angles_between(cloud.quats, packed_in_frames(cloud, frames).quats)
    plain = angles_between(cloud.quats, spark.decode(spark.encode(cloud)).quats)

    assert found.mean() <= 0.20
    assert found.max() <= 0.55
    assert plain.mean() >= 0.58  # what the search is worth


def test_encode__small_takes_the_smallest_turn():
    cloud = make_cloud(5000, 0)

    plain, small = (spark.encode(cloud, rotation=rotation).packed[:, 3] >> 24 for rotation in ("reference", "small"))

    # No rotation is further than 62.8 degrees from the nearest relabeling of the axes.
    assert small.max() <= np.ceil(62.8 / 180 * 255)
    assert plain.max() == 255
    assert (small <= plain).all()


@pytest.mark.parametrize("rotation", ["reference", "best", "small"])
def test_encode__gives_the_same_bits_for_any_threads_and_any_split(rotation):
    cloud = make_cloud(40_003, 2)

    with use_jobs(1):
        one = spark.encode(cloud, rotation=rotation)
    with use_jobs(3):
        three = spark.encode(cloud, rotation=rotation)
    parts = [spark.encode(cloud.take(slice(start, start + 977)), rotation=rotation) for start in range(0, len(cloud), 977)]

    for name in ("packed", "sh1", "sh2"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
        np.testing.assert_array_equal(getattr(one, name), np.concatenate([getattr(part, name) for part in parts]))


def within(source, decoded, bounds, slack=1e-6):
    """Names of the attributes that leave their bounds."""
    pairs = {
        "means": (source.means, decoded.means),
        "scales": (np.sort(source.log_scales, axis=1), np.sort(decoded.log_scales, axis=1)),
        "opacities": tuple(1 / (1 + np.exp(-c.opacity_logits.astype(np.float64))) for c in (source, decoded)),
        "sh0": (source.sh0, decoded.sh0),
        "shN": (source.shN, decoded.shN),
    }
    outside = []
    for name, (a, b) in pairs.items():
        with np.errstate(invalid="ignore"):
            errors = np.where(a == b, 0, np.abs(a.astype(np.float64) - b))
        if name in bounds and not (errors <= bounds[name] + slack * np.nan_to_num(np.abs(a), posinf=0, neginf=0)).all():
            outside.append(name)
    return outside


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.LossyConversionWarning", "ignore:overflow:RuntimeWarning")
@settings(max_examples=40)
@given(st.integers(0, 2**32), st.sampled_from(["reference", "best", "small"]), st.booleans())
def test_spark_bounds__hold_for_values_within_and_beyond_the_ranges(seed, rotation, is_fit):
    rng = np.random.default_rng(seed)
    spread = rng.choice([0.1, 1, 4])
    cloud = make_cloud(64, 4, seed)
    cloud = cloud.replace(
        means=cloud.means * np.float32(10.0 ** rng.uniform(-9, 2.5)), log_scales=cloud.log_scales * np.float32(spread),
        sh0=cloud.sh0 * np.float32(spread), shN=cloud.shN * np.float32(spread),
    )  # fmt: skip
    encoding = spark.fit_encoding([cloud]) if is_fit else spark.SplatEncoding()

    decoded = spark.decode(spark.encode(cloud, encoding=encoding, rotation=rotation))

    bounds = limits.spark_bounds(cloud, encoding)
    assert within(cloud, decoded, bounds) == []
    assert (relative_covariance_errors(cloud, decoded) <= bounds["covariances"] + 1e-5).all()


@given(hnp.arrays(np.float32, (50, 4), elements=st.floats(-1, 1, width=32)))
def test_spark_angle__bounds_the_rotation_error_for_every_quaternion(quats):
    quats = quats[np.linalg.norm(quats.astype(np.float64), axis=1) > 1e-20]
    cloud = make_cloud(len(quats), 0).replace(quats=quats)

    found = angles_between(quats, spark.decode(spark.encode(cloud)).quats)

    assert (found <= np.rad2deg(limits.SPARK_ANGLE)).all()


def test_spark_angle__is_nearly_reached():
    cloud = make_cloud(200_000, 0)

    found = angles_between(cloud.quats, spark.decode(spark.encode(cloud)).quats)

    assert found.max() >= 0.95 * np.rad2deg(limits.SPARK_ANGLE)


def test_fit_encoding__clamps_nothing_and_narrows_every_step():
    cloud = make_cloud(2000, 4)
    cloud = cloud.replace(log_scales=np.where(np.arange(3) == 1, np.float32(-np.inf), cloud.log_scales * np.float32(0.4)))
    cloud = cloud.replace(shN=cloud.shN * np.float32(0.2), sh0=cloud.sh0 * np.float32(2.5))

    encoding = spark.fit_encoding([cloud.take(slice(0, 700)), cloud.take(slice(700, None))])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        decoded = spark.decode(spark.encode(cloud, encoding=encoding))
    assert encoding.ln_scale_step < 0.021
    assert max(encoding.sh_max(band) for band in range(1, 5)) <= 0.181
    assert all(np.float32(value) == value for value in encoding.to_json().values())
    assert np.abs(decoded.shN - cloud.shN)[:, 15:].max() <= encoding.sh4_max / 14 + 1e-6
    assert np.isneginf(decoded.log_scales[:, 1]).all()


def test_fit_encoding__keeps_a_range_where_all_values_are_alike():
    cloud = make_cloud(4, 1)
    cloud = cloud.replace(sh0=np.full((4, 3), 0.3), log_scales=np.full((4, 3), -4.0), shN=np.zeros((4, 3, 3)))

    encoding = spark.fit_encoding([cloud])

    decoded = spark.decode(spark.encode(cloud, encoding=encoding))
    np.testing.assert_allclose(decoded.sh0, 0.3, atol=1e-4)
    np.testing.assert_allclose(decoded.log_scales, -4, atol=1e-5)
    assert encoding.sh1_max == 1.0


def test_fit_encoding__of_nothing_is_the_default():
    assert spark.fit_encoding([make_cloud(0, 3)]) == spark.SplatEncoding()


def test_splat_encoding__speaks_the_names_of_spark():
    entry = spark.SplatEncoding(rgb_min=-1).to_json()

    assert list(entry) == ["rgbMin", "rgbMax", "lnScaleMin", "lnScaleMax", "sh1Max", "sh2Max", "sh3Max", "sh4Max"]
    assert spark.SplatEncoding.from_json(entry) == spark.SplatEncoding(rgb_min=-1)
    assert spark.SplatEncoding.from_json({"lodOpacity": False}) == spark.SplatEncoding()


@pytest.mark.parametrize(
    "ranges", [{"rgb_max": 0.0}, {"ln_scale_min": float("nan")}, {"sh2_max": -1.0}, {"sh3_max": float("inf")}]
)
def test_splat_encoding__refuses_empty_ranges(ranges):
    with pytest.raises(ValueError, match="must have an extent"):
        spark.SplatEncoding(**ranges)


def test_encode__refuses_positions_beyond_half_and_counts_them():
    cloud = make_cloud(10, 0)
    means = cloud.means.copy()
    means[3, 1], means[7, 2], means[8, 0] = 65520, -1e9, 65519

    with pytest.raises(CapabilityError, match=r"2 of 10 splats lie beyond 65504.*up to 1e\+09.*--recenter on"):
        spark.encode(cloud.replace(means=means))


@pytest.mark.parametrize(
    ("name", "value"),
    [("means", np.nan), ("means", np.inf), ("quats", np.nan), ("quats", np.inf), ("log_scales", np.nan), ("log_scales", np.inf),
     ("opacity_logits", np.nan), ("sh0", -np.inf), ("shN", np.nan), ("shN", np.inf)],
)  # fmt: skip
def test_encode__refuses_values_that_are_not_numbers(name, value):
    cloud = make_cloud(5, 1)
    values = getattr(cloud, name).copy()
    values.reshape(5, -1)[2, 0] = value

    with pytest.raises(CloudError, match=r"^(\w+: )?1 "):
        spark.encode(cloud.replace(**{name: values}))


def test_encode__warns_about_clamped_values_with_counts():
    cloud = make_cloud(6, 2)
    sh0, log_scales, rest = cloud.sh0.copy(), cloud.log_scales.copy(), cloud.shN.copy()
    sh0[0, :2], log_scales[1, 0], log_scales[2, 0], rest[3, 1, 0], rest[4, 5, 2] = 4, -12.2, -40, 1.1, -2

    with pytest.warns(LossyConversionWarning) as caught:
        pack = spark.encode(cloud.replace(sh0=sh0, log_scales=log_scales, shN=rest))

    messages = {warning.message.code: str(warning.message) for warning in caught}
    assert "2 color channels outside 0..1" in messages["clamped"]
    assert "1 scale axes outside e^-12..e^9" in messages["clamped"]
    assert "1 SH values of band 1 beyond 1, 1 SH values of band 2" in messages["clamped"]
    assert "1 scale axes below e^-30 became exactly flat" in messages["flattened"]
    assert pack.clamped == {"colors": 2, "scales": 1, "flattened": 1, "sh1": 1, "sh2": 1}


def test_encode__leaves_its_argument_alone_and_keeps_metadata():
    cloud = make_cloud(
        100, 1, has_motion=True, coordinate_system="RDF", origin=[1, 2, 3], splat_model="2dgs", time_model="gaussian"
    )
    before = {name: values.copy() for name, values in cloud.arrays().items()}

    decoded = spark.decode(spark.encode(cloud, rotation="best"))

    for name, values in before.items():
        np.testing.assert_array_equal(getattr(cloud, name), values)
    for name in ("velocities", "times", "durations"):
        np.testing.assert_array_equal(getattr(decoded, name), getattr(cloud, name))
    for name in ("coordinate_system", "splat_model", "time_model"):
        assert getattr(decoded, name) == getattr(cloud, name)
    np.testing.assert_array_equal(decoded.origin, cloud.origin)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65])
def test_encode__takes_any_number_of_splats(count):
    cloud = make_cloud(count, 4)

    pack = spark.encode(cloud, rotation="best")

    assert pack.packed.shape == (count, 4)
    assert len(spark.decode(pack)) == count
    assert pack.clamped == {}


def test_encode__refuses_an_unknown_rotation():
    with pytest.raises(ValueError, match="rotation must be one of reference, best, small"):
        spark.encode(make_cloud(1, 0), rotation="worst")
