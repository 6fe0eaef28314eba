"""web/gspk.mjs in Chromium, on files from a builder of ours that follows the specification and on files of the package."""

import json

import numpy as np
import pytest
import zstandard

import gsplat_tools
from gsplat_tools.formats.pack import spark
from gsplat_tools.reference.rasterizer import render
from tests.browser.chromium import BrowserError
from tests.browser.gspk_builder import build_gspk, change_description, make_words
from tests.browser.scenes import looking_at_origin, make_scene
from tests.browser.spark_renderer import TEXTURE_WIDTH, draw_pack, draw_with_spark, psnr, scene_settings, to_image

pytestmark = pytest.mark.browser

FITTED = {"rgbMin": -0.5, "rgbMax": 1.25, "lnScaleMin": -7, "lnScaleMax": -1, "sh1Max": 0.25, "sh2Max": 0.5, "sh3Max": 0.125}
DEFAULTS = {"rgbMin": 0, "rgbMax": 1, "lnScaleMin": -12, "lnScaleMax": 9, "sh1Max": 1, "sh2Max": 1, "sh3Max": 1}


def uncompressed_arrays(rng, num_splats, degree):
    shapes = {"positions": (3,), "colors": (4,), "scales": (3,), "rotations": (4,), "shs": ((degree + 1) ** 2 - 1, 3)}
    if degree == 0:
        del shapes["shs"]
    return {name: rng.normal(size=(num_splats, *shape)).astype(np.float32) for name, shape in shapes.items()}


def padded(words):
    rows = -(-len(words) // TEXTURE_WIDTH) * TEXTURE_WIDTH
    return words.tobytes() + bytes((rows - len(words)) * words[0].nbytes)


@pytest.mark.parametrize("codec", ["zstd", "none"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_read_gspk__gives_spark_every_word_padded_to_whole_rows(browser, codec, degree):
    words = make_words(np.random.default_rng(degree), 3000, degree, scale_bytes=(60, 120))
    file = build_gspk(words, degree=degree, codec=codec, frame_rows=1000)

    for name in words:
        array = {"packed": "packedArray", "sh4": "sh4"}.get(name, f"extra.{name}")
        report, found = browser.call("readGspk", {"array": array}, file=file)
        assert found == (words[name].tobytes() if name == "sh4" else padded(words[name]))
    assert report["numSplats"] == report["count"] == 3000
    assert report["degree"] == degree
    assert set(report["extra"]) == {f"sh{band}" for band in range(1, min(degree, 3) + 1)}
    assert report["packedArray"]["type"] == "Uint32Array"
    assert report["splatEncoding"] == DEFAULTS


def test_padded_count__fills_whole_rows_and_beyond_one_layer_whole_layers(browser):
    row, layer = 2048, 2048 * 2048

    report, _ = browser.call("padCounts", {"counts": [0, 1, row, row + 1, layer - 1, layer, layer + 1, 3 * layer]})

    # Spark 2.2.0 fails to upload 4,194,305 splats that fill rows only (WebGL error 1282).
    assert report["padded"] == [row, row, row, 2 * row, layer, layer, 2 * layer, 3 * layer]


def test_read_gspk__passes_the_encoding_on_without_the_band_that_spark_has_not(browser):
    words = make_words(np.random.default_rng(0), 5, 0, scale_bytes=(60, 120))

    report, _ = browser.call("readGspk", {}, file=build_gspk(words, splat_encoding={**FITTED, "sh4Max": 0.5}))

    assert report["splatEncoding"] == FITTED


@pytest.mark.parametrize("codec", ["zstd", "none"])
@pytest.mark.parametrize("degree", [0, 2, 4])
def test_read_gspk__gives_the_uncompressed_arrays_as_they_are(browser, codec, degree):
    arrays = uncompressed_arrays(np.random.default_rng(degree), 700, degree)
    file = build_gspk(arrays, layout="uncompressed", degree=degree, codec=codec, frame_rows=300)

    for name, array in arrays.items():
        report, found = browser.call("readGspk", {"array": name}, file=file)
        assert found == array.tobytes()
        # Codec `none` is for mapping: the arrays lie in the file's own buffer.
        assert report[name] == {"type": "Float32Array", "length": array.size, "isView": codec == "none"}
    assert ("shs" in report) == (degree > 0)


def test_read_gspk__gives_motion_and_what_else_the_file_says(browser):
    rng = np.random.default_rng(0)
    motion = {
        "velocities": rng.normal(size=(50, 3)).astype(np.float32),
        "times": rng.random(50, np.float32),
        "durations": rng.random(50, np.float32),
    }
    said = {
        "time_model": "gaussian",
        "origin": [1e6, -2.5, 0.1],
        "coordinate_system": "RUB",
        "splat_model": "antialiased",
        "bounds": {"min": [-1, -2, -3], "max": [1, 2, 3]},
    }
    file = build_gspk({**make_words(rng, 50, 0, scale_bytes=(60, 120)), **motion}, **said)

    for name, array in motion.items():
        report, found = browser.call("readGspk", {"array": f"motion.{name}"}, file=file)
        assert found == array.tobytes()
    assert report["motion"]["timeModel"] == "gaussian"
    assert (report["origin"], report["coordinateSystem"], report["splatModel"]) == ([1e6, -2.5, 0.1], "RUB", "antialiased")
    assert report["bounds"] == said["bounds"]


def test_read_gspk__ignores_streams_and_keys_that_it_does_not_know(browser):
    rng = np.random.default_rng(0)
    words = make_words(rng, 10, 0, scale_bytes=(60, 120))
    file = build_gspk({**words, "labels": rng.integers(0, 9, (10, 1), np.uint32)}, colour_of_the_day="teal")

    _, found = browser.call("readGspk", {"array": "packedArray"}, file=file)

    assert found == padded(words["packed"])


@pytest.mark.parametrize("codec", ["zstd", "none"])
def test_read_gspk__accepts_a_pack_without_splats(browser, codec):
    words = make_words(np.random.default_rng(0), 0, 1, scale_bytes=(60, 120))
    file = build_gspk(words, degree=1, codec=codec)
    camera = looking_at_origin(16, 8)

    report, _ = browser.call("readGspk", {}, file=file)
    _, pixels = browser.call("drawGspk", scene_settings(camera), file=file)

    assert report["numSplats"] == 0
    assert (to_image(pixels, camera) == [0, 0, 0, 255]).all()


@pytest.mark.parametrize("encoding", [None, FITTED], ids=["default", "fitted"])
@pytest.mark.parametrize("codec", ["zstd", "none"])
def test_draw_gspk__draws_the_pixels_of_the_arrays_themselves(browser, codec, encoding):
    scale_bytes = (100, 220) if encoding else (85, 125)
    words = make_words(np.random.default_rng(7), 2500, 3, scale_bytes=scale_bytes)
    file = build_gspk(words, degree=3, codec=codec, **({"splat_encoding": encoding} if encoding else {}))
    camera = looking_at_origin(160, 100)

    report, pixels = browser.call("drawGspk", scene_settings(camera), file=file)

    drawn = to_image(pixels, camera)
    assert np.array_equal(drawn, draw_with_spark(browser, camera, **words, encoding=encoding))
    assert report["splatEncoding"] == (encoding or DEFAULTS)
    assert report["numSh"] == 3
    # Something to see, and not the same with another encoding or without the bands.
    assert (drawn[..., :3] > 0).mean() > 0.5
    assert not np.array_equal(drawn, draw_with_spark(browser, camera, **words, encoding=None if encoding else FITTED))
    assert not np.array_equal(drawn, draw_with_spark(browser, camera, words["packed"], encoding=encoding))


@pytest.mark.parametrize("spark_encoding", ["default", "fit"])
@pytest.mark.parametrize("codec", ["zstd", "none"])
def test_draw_gspk__draws_files_of_the_package_as_their_words_and_as_the_model(browser, tmp_path, codec, spark_encoding):
    cloud = make_scene(3)
    encoding = spark.fit_encoding([cloud]) if spark_encoding == "fit" else spark.SplatEncoding()
    camera = looking_at_origin(320, 200)

    path = tmp_path / "scene.gspk"
    gsplat_tools.save(cloud, path, codec=codec, spark_encoding=spark_encoding, rotation="reference", order="none")
    report, pixels = browser.call("drawGspk", scene_settings(camera), file=path.read_bytes())
    pack = spark.encode(cloud, encoding=encoding, rotation="reference")

    drawn = to_image(pixels, camera)
    assert (report["numSplats"], report["numSh"]) == (len(cloud), 3)
    assert np.array_equal(drawn, draw_pack(browser, camera, pack))
    ours = render(gsplat_tools.load(path), camera, model="spark", framebuffer="unorm8")
    assert psnr(drawn, ours.image) >= 50.0


@pytest.mark.parametrize("codec", ["zstd", "none"])
def test_read_gspk__reads_the_uncompressed_files_of_the_package(browser, tmp_path, codec):
    cloud = make_scene(4)
    path = tmp_path / "scene.gspk"
    gsplat_tools.save(cloud, path, to="uncompressed", codec=codec, order="none")

    file = path.read_bytes()

    report, positions = browser.call("readGspk", {"array": "positions"}, file=file)
    _, shs = browser.call("readGspk", {"array": "shs"}, file=file)
    assert (report["layout"], report["count"], report["degree"]) == ("uncompressed", len(cloud), 4)
    assert positions == cloud.means.tobytes()
    assert shs == cloud.shN.tobytes()


def test_draw_gspk__refuses_the_uncompressed_layout_and_says_what_to_do(browser):
    file = build_gspk(uncompressed_arrays(np.random.default_rng(0), 3, 0), layout="uncompressed")

    with pytest.raises(BrowserError, match="layout uncompressed: write it with gsplat-convert --to spark"):
        browser.call("drawGspk", scene_settings(looking_at_origin(8, 8)), file=file)


def stream(**changes):
    return lambda content: content["streams"][0].update(changes)


def replace(**changes):
    return lambda content: content.update(changes)


def put(offset, data):
    return lambda file: file[:offset] + data + file[offset + len(data) :]


DAMAGED = {
    "empty": (lambda file: b"", "magic", 0, "does not start with GSPK"),
    "another format": (put(0, b"ply\n"), "magic", 0, "does not start with GSPK"),
    "header cut": (lambda file: file[:40], "header", 0, "the file only 40"),
    "version": (put(4, b"\2"), "version", 4, "version 2 is not read"),
    "cut": (lambda file: file[:-1], "file_length", 8, "the header promises"),
    "longer": (lambda file: file + b"\0", "file_length", 8, "the header promises"),
    "json offset": (put(16, b"\3"), "json_offset", 16, "at least 64, found 3"),
    "json length": (put(24, b"\0\0\1"), "json_length", 24, "the description ends at"),
    "json too long": (put(28, b"\1"), "json_length", 24, "at most"),
    "beyond 2^53": (put(23, b"\1"), "json_offset", 16, "beyond 2"),
    "reserved": (put(50, b"\7"), "reserved", 50, "expected 0, found 7"),
    "layout in the header": (put(36, b"\1"), "layout", 36, "1 does not stand for the description's layout spark"),
    "json checksum": (put(70, b"\0"), "json_crc32", 32, "the bytes are damaged"),
    "layout": (replace(layout="ksplat"), "layout", 64, 'found "ksplat"'),
    "count": (replace(count=-1), "count", 64, "found -1"),
    "degree": (replace(degree=5), "degree", 64, "0 to 4, found 5"),
    "frame rows": (replace(frame_rows=0), "frame_rows", 64, "at least 1"),
    "no streams": (replace(streams=None), "streams", 64, "expected a list"),
    "stream missing": (replace(degree=3), "streams", None, "needs a stream sh2"),
    "stream twice": (lambda c: c["streams"].append(c["streams"][0]), "streams", 64, "packed is there twice"),
    "motion in part": (lambda c: c["streams"].append({"name": "times"}), "streams", None, "needs a stream velocities"),
    "dtype": (stream(dtype="f32"), "packed", ..., "expected dtype u32"),
    "shape": (stream(shape=[90, 3]), "packed", ..., r"expected shape \[90,4\]"),
    "count and shape": (replace(count=91), "packed", ..., r"expected shape \[91,4\]"),
    "raw length": (stream(raw_length=1439), "packed", ..., "the shape needs 1440"),
    "offset": (stream(offset=65), "packed", 65, "no multiple of 64"),
    "offset in the header": (stream(offset=0), "packed", 0, "behind the header"),
    "offset beyond": (stream(offset=1 << 40), "packed", 1 << 40, "the file ends at"),
    "over the description": (stream(offset=64), "packed", 64, "overlaps description"),
    "over another": (lambda c: c["streams"][1].update(offset=c["streams"][0]["offset"]), ..., ..., "it overlaps"),
    "codec": (stream(codec="lz4"), "packed", ..., 'found "lz4"'),
    "frames": (stream(frames=[1]), "packed", ..., "expected 3 frames of 40 rows"),
    "frame lengths": (stream(frames=[1, 2, 3]), "packed", ..., "the frames add up to 6"),
    "checksums": (stream(crc32=[]), "packed", ..., "expected 3 checksums"),
    "encoding": (replace(splat_encoding={"rgbMax": "wide"}), "splat_encoding.rgbMax", None, "expected a number"),
    "empty range": (replace(splat_encoding={"lnScaleMin": 9}), "splat_encoding.lnScaleMax", None, "above lnScaleMin"),
}


@pytest.mark.parametrize("codec", ["zstd", "none"])
@pytest.mark.parametrize("case", DAMAGED)
def test_read_gspk__names_field_and_offset_of_what_is_wrong(browser, case, codec):
    damage, field, offset, message = DAMAGED[case]
    file = build_gspk(make_words(np.random.default_rng(3), 90, 1, scale_bytes=(60, 120)), degree=1, codec=codec, frame_rows=40)
    is_change_of_bytes = case in list(DAMAGED)[: list(DAMAGED).index("layout")]
    damaged = damage(file) if is_change_of_bytes else change_description(file, damage)

    with pytest.raises(BrowserError, match=message) as caught:
        browser.call("readGspk", {}, file=damaged)

    error = caught.value.error
    assert error["name"] == "GspkError"
    assert field is ... or error.get("field") == field
    assert offset is ... or error.get("offset") == offset


@pytest.mark.parametrize("codec", ["zstd", "none"])
def test_read_gspk__finds_a_changed_byte_by_its_checksum(browser, codec):
    words = make_words(np.random.default_rng(3), 90, 0, scale_bytes=(60, 120))
    file = bytearray(build_gspk(words, codec=codec, frame_rows=40))
    content = json.loads(file[64 : 64 + int.from_bytes(file[24:32], "little")])
    packed = content["streams"][0]
    second = packed["offset"] + packed["frames"][0]
    # Random words do not compress: zstd stores them raw, so that a changed byte stays a valid frame.
    file[second + packed["frames"][1] // 2] ^= 0x10

    with pytest.raises(BrowserError, match="the bytes are damaged") as caught:
        browser.call("readGspk", {}, file=bytes(file))
    _, found = browser.call("readGspk", {"array": "packedArray", "options": {"verify": False}}, file=bytes(file))

    assert (caught.value.error["field"], caught.value.error["offset"]) == ("packed", second)
    assert sum(a != b for a, b in zip(found, padded(words["packed"]), strict=True)) == 1


@pytest.mark.parametrize(
    ("make_frame", "message"),
    [
        (lambda raw: zstandard.ZstdCompressor().compress(raw[:-16]), "states 1424"),
        (lambda raw: zstandard.ZstdCompressor(write_content_size=False).compress(raw), "states no size"),
        (lambda raw: b"\0" * 40, "states no size"),
        (lambda raw: zstandard.ZstdCompressor().compress(raw)[:-9], "does not decompress"),
    ],
    ids=["shorter", "no size", "not zstd", "cut"],
)
def test_read_gspk__refuses_frames_that_do_not_hold_their_rows(browser, make_frame, message):
    words = make_words(np.random.default_rng(3), 90, 0, scale_bytes=(60, 120))
    frame = make_frame(words["packed"].tobytes())
    stored = build_gspk(words)

    def put_frame(content):
        content["streams"][0].update(frames=[len(frame)], stored_length=len(frame))

    changed = change_description(stored, put_frame)
    place = json.loads(changed[64 : 64 + int.from_bytes(changed[24:32], "little")])["streams"][0]["offset"]
    file = changed[:place] + frame + changed[place + len(frame) :]

    with pytest.raises(BrowserError, match=message) as caught:
        browser.call("readGspk", {}, file=file)

    assert caught.value.error["name"] == "GspkError"
    assert caught.value.error["field"] == "packed"


def test_read_gspk__refuses_a_file_that_claims_far_more_than_it_holds(browser):
    rows = np.zeros((2_000_000, 4), np.uint32)

    with pytest.raises(BrowserError, match="more than 1024 times its"):
        browser.call("readGspk", {}, file=build_gspk({"packed": rows}, frame_rows=2_000_000))


def test_read_gspk__says_when_a_decompressor_is_needed(browser):
    words = make_words(np.random.default_rng(3), 90, 0, scale_bytes=(60, 120))

    _, found = browser.call(
        "readGspk", {"array": "packedArray", "withoutDecompressor": True}, file=build_gspk(words, codec="none")
    )
    with pytest.raises(BrowserError, match="pass a `decompress`"):
        browser.call("readGspk", {"withoutDecompressor": True}, file=build_gspk(words))

    assert found == padded(words["packed"])
