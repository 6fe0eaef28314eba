"""Images as data: lossless WebP of RGBA bytes, exact, its size checked before anything is decoded."""

from __future__ import annotations

import io
import re
import struct
from dataclasses import dataclass
from functools import cache
from typing import cast

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import CorruptDataError, MissingDependencyError, TruncatedDataError
from gsplat_tools.remembering import remembered

SOUND_LIBWEBP = (1, 3, 2)
"""Earlier versions of libwebp do not decode hostile files safely."""

MAX_SIDE = 16383
"""Largest width and height of a WebP image (RFC 9649: 14 bits each)."""

Image = NDArray[np.uint8]
"""(height, width, 4) RGBA."""

# Settings (method, quality) that are tried at each effort; the smallest result is kept. libwebp looks for repeats 64 rows
# back at qualities above 25, 256 rows above 50, and everywhere above 75; methods above 2 cost more and shrink images of
# splats by 0.2 percent at most (docs/codebooks.md). Beyond DEFAULT_EFFORT one setting alone gains nothing everywhere.
_THOROUGH = ((2, 70), (4, 70), (3, 40), (1, 80), (5, 75), (6, 75), (2, 90))
_EFFORTS = (((0, 0),), ((1, 40),), ((1, 70),), *(_THOROUGH[: count + 1] for count in range(7)))
DEFAULT_EFFORT = 3


@dataclass(frozen=True, slots=True)
class WebpHeader:
    """What the first bytes of a WebP file say."""

    width: int
    height: int
    is_lossless: bool
    is_animated: bool


@remembered
def encode_rgba(image: Image, effort: int = DEFAULT_EFFORT) -> bytes:
    """Return an image as lossless WebP that decodes to the same bytes, also where alpha is 0.

    Parameters
    ----------
    image
        (height, width, 4) RGBA, each side at most MAX_SIDE.
    effort
        0 (fastest) to 9 (smallest).

    Raises
    ------
    MissingDependencyError
        Pillow was built without libwebp.
    """
    from PIL.Image import fromarray

    if not 0 <= effort < len(_EFFORTS):
        raise ValueError(f"effort must be 0 to {len(_EFFORTS) - 1}, got {effort}")
    source = fromarray(image, "RGBA")
    results = []
    for method, quality in _EFFORTS[effort]:
        target = io.BytesIO()
        try:
            # Without `exact` libwebp changes colors where alpha is 0.
            source.save(target, "WEBP", lossless=True, exact=True, method=method, quality=quality)
        except KeyError as error:
            raise MissingDependencyError("this Pillow cannot write WebP; install one that has libwebp") from error
        results.append(target.getvalue())
    return min(results, key=len)


def parse_header(data: bytes, *, field: str, frame: int | None = None) -> WebpHeader:
    """Return the size and kind of a WebP file without decoding it.

    Raises
    ------
    CorruptDataError
        The bytes are not a WebP file.
    TruncatedDataError
        The file is shorter than its header says.

    Source
    ------
    RFC 9649, WebP Image Format, sections 2.3 to 2.7 and 3.4.
    """
    if len(data) < 20 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise CorruptDataError(f"expected a WebP image, found {data[:12]!r}", field=field, frame=frame)
    size = struct.unpack_from("<I", data, 4)[0] + 8
    if size > len(data):
        raise TruncatedDataError(f"the WebP header says {size} bytes but there are {len(data)}", field=field, frame=frame)
    kind, payload = data[12:16], data[20:]
    if kind == b"VP8L" and len(payload) >= 5 and payload[0] == 0x2F:
        bits = struct.unpack_from("<I", payload, 1)[0]
        return WebpHeader(1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), is_lossless=True, is_animated=False)
    if kind == b"VP8X" and len(payload) >= 10:
        width = 1 + int.from_bytes(payload[4:7], "little")
        height = 1 + int.from_bytes(payload[7:10], "little")
        return WebpHeader(width, height, is_lossless=_has_lossless_chunk(data), is_animated=bool(payload[0] & 2))
    if kind == b"VP8 " and len(payload) >= 10:
        width, height = struct.unpack_from("<HH", payload, 6)
        return WebpHeader(width & 0x3FFF, height & 0x3FFF, is_lossless=False, is_animated=False)
    raise CorruptDataError(f"expected a WebP image, found a chunk {kind!r} without a size", field=field, frame=frame)


def most_bytes(width: int, height: int) -> int:
    """Return more than any encoder makes of an image: its bytes, and room for headers and metadata."""
    return 8 * width * height + (1 << 20)


def decode_rgba(data: bytes, width: int, height: int, *, field: str, frame: int | None = None) -> Image:
    """Decode a lossless WebP file of a known size.

    Parameters
    ----------
    data
        The file.
    width, height
        The size that it must have.
    field, frame
        What errors name.

    Returns
    -------
    Image
        (height, width, 4) RGBA; alpha is 255 where the file has none.

    Raises
    ------
    CorruptDataError
        Not a lossless still image of that size, or it does not decompress.
    TruncatedDataError
        The file is shorter than its header says.
    MissingDependencyError
        Pillow was built without libwebp.
    """
    require_sound_library()
    header = parse_header(data, field=field, frame=frame)
    if (header.width, header.height) != (width, height):
        raise CorruptDataError(
            f"expected an image of {width} x {height} pixels, found {header.width} x {header.height}", field=field, frame=frame
        )
    if not header.is_lossless or header.is_animated:
        kind = "an animation" if header.is_animated else "a lossy image"
        raise CorruptDataError(f"expected a lossless image, found {kind}: its values are not data", field=field, frame=frame)
    try:
        from PIL.WebPImagePlugin import WebPImageFile
    except ImportError as error:
        raise MissingDependencyError("this Pillow cannot read WebP; install one that has libwebp") from error
    try:
        # Not Image.open: its limit against decompression bombs is below what the size check above allows on purpose.
        with WebPImageFile(io.BytesIO(data)) as opened:
            pixels = np.asarray(opened.convert("RGBA"))
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise CorruptDataError(f"the WebP image does not decompress ({error})", field=field, frame=frame) from error
    if pixels.shape != (height, width, 4):
        raise CorruptDataError(
            f"expected an image of {width} x {height} pixels, found {pixels.shape[1]} x {pixels.shape[0]} behind the header",
            field=field,
            frame=frame,
        )
    return cast("Image", pixels)


@cache
def require_sound_library() -> None:
    """Refuse a libwebp that writes beyond its buffers when it decodes what a hostile file holds.

    Raises
    ------
    MissingDependencyError
        It is older than 1.3.2.

    Source
    ------
    CVE-2023-4863: heap buffer overflow in the Huffman tables of lossless images, corrected in libwebp 1.3.2.
    """
    from PIL import features

    version = features.version("webp")
    found = tuple(int(part) for part in re.findall(r"\d+", version or "")[:3])
    if found and found < SOUND_LIBWEBP:
        raise MissingDependencyError(
            f"libwebp {version} can be taken over by hostile images (CVE-2023-4863); install Pillow 10.0.1 or later, or "
            f"libwebp {'.'.join(map(str, SOUND_LIBWEBP))}"
        )


def _has_lossless_chunk(data: bytes) -> bool:
    """Whether an extended file holds its image as VP8L."""
    position = 12
    while position + 8 <= len(data):
        kind, size = data[position : position + 4], struct.unpack_from("<I", data, position + 4)[0]
        if kind in {b"VP8L", b"VP8 "}:
            return kind == b"VP8L"
        position += 8 + size + (size & 1)
    return False
