"""Images as data: exact, sizes known before anything is decoded."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, features

from gsplat_tools.errors import CorruptDataError, FormatError, MissingDependencyError
from gsplat_tools.formats import _webp
from gsplat_tools.formats._webp import decode_rgba, encode_rgba, parse_header


def picture(width: int = 7, height: int = 5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 4)).astype(np.uint8)


def saved(pixels: np.ndarray, **options: object) -> bytes:
    target = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(target, "WEBP", **options)
    return target.getvalue()


@given(width=st.integers(1, 20), height=st.integers(1, 20), effort=st.integers(0, 9), seed=st.integers(0, 99))
def test_images__come_back_exactly(width: int, height: int, effort: int, seed: int) -> None:
    pixels = picture(width, height, seed)
    pixels[..., 3] *= pixels[..., 3] > 128  # colors under alpha 0

    data = encode_rgba(pixels, effort)

    header = parse_header(data, field="x")
    assert (header.width, header.height, header.is_lossless) == (width, height, True)
    assert np.array_equal(decode_rgba(data, width, height, field="x"), pixels)


def test_library__is_new_enough_to_be_safe() -> None:
    version = tuple(int(part) for part in str(features.version("webp")).split("."))

    assert version >= (1, 3, 2)  # CVE-2023-4863


def test_size__is_checked_before_decoding() -> None:
    data = bytearray(encode_rgba(picture()))
    del data[40:]  # nothing left to decode
    data[4:8] = struct.pack("<I", len(data) - 8)

    with pytest.raises(CorruptDataError, match="8 x 5 pixels, found 7 x 5"):
        decode_rgba(bytes(data), 8, 5, field="a.webp", frame=3)


def test_lossy_and_moving_images__are_refused() -> None:
    with pytest.raises(CorruptDataError, match="a lossy image"):
        decode_rgba(saved(picture(), quality=50), 7, 5, field="x")
    target = io.BytesIO()
    frames = [Image.fromarray(picture(seed=seed), "RGBA") for seed in range(2)]
    frames[0].save(target, "WEBP", save_all=True, append_images=frames[1:], lossless=True)
    with pytest.raises(CorruptDataError, match="an animation"):
        decode_rgba(target.getvalue(), 7, 5, field="x")


def test_extended_file__with_a_lossless_image_is_read() -> None:
    pixels = picture()

    data = saved(pixels, lossless=True, exact=True, xmp=b"<x/>")

    assert data[12:16] == b"VP8X"
    assert np.array_equal(decode_rgba(data, 7, 5, field="x"), pixels)


def test_opaque_image__reads_alpha_255() -> None:
    pixels = picture()
    pixels[..., 3] = 255

    assert np.array_equal(decode_rgba(encode_rgba(pixels), 7, 5, field="x"), pixels)


def test_damage__is_refused_or_read_and_nothing_else() -> None:
    data = encode_rgba(picture())
    for position in range(len(data)):
        for change in (1, 0x80, 0xFF):
            damaged = bytearray(data)
            damaged[position] ^= change
            try:
                decode_rgba(bytes(damaged), 7, 5, field="x")
            except FormatError:
                continue
    for length in range(len(data)):
        with pytest.raises(FormatError):
            decode_rgba(data[:length], 7, 5, field="x")


def test_effort__is_checked() -> None:
    with pytest.raises(ValueError, match="0 to 9"):
        encode_rgba(picture(), 10)


def test_default_effort__finds_what_repeats_two_hundred_rows_later() -> None:
    rows = np.random.default_rng(0).integers(0, 256, (200, 48, 4), np.uint8)

    once, twice = (len(encode_rgba(np.ascontiguousarray(np.tile(rows, (count, 1, 1))))) for count in (1, 2))

    assert twice < 1.1 * once


@pytest.mark.parametrize(("version", "is_sound"), [("1.3.1", False), ("0.6.1", False), ("1.3.2", True), ("1.6.0", True)])
def test_decode__refuses_a_library_that_hostile_images_take_over(
    version: str, is_sound: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from PIL import features

    monkeypatch.setattr(features, "version", {"webp": version}.get)
    _webp.require_sound_library.cache_clear()
    try:
        if is_sound:
            _webp.require_sound_library()
        else:
            with pytest.raises(MissingDependencyError, match="CVE-2023-4863"):
                _webp.decode_rgba(b"", 1, 1, field="x")
    finally:
        _webp.require_sound_library.cache_clear()
