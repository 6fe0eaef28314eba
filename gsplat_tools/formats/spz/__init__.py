"""SPZ, the compressed splats of Niantic: attribute after attribute, gzip (versions 1 to 3) or zstd (version 4).

| attribute | bytes a splat | value |
|---|---|---|
| positions | 9 (6 in version 1) | 24-bit fixed point with fractionalBits behind the point (three halves in version 1) |
| alphas | 1 | opacity x 255 |
| colors | 3 | (0.15 sh0 + 0.5) x 255 |
| scales | 3 | (log scale + 10) x 16 |
| rotations | 4 (3 in versions 1 and 2) | smallest three of x, y, z, w (x, y, z with w >= 0) |
| sh | 0, 9, 24, 45, 72 | 128 (value + 1), coefficient by coefficient, red, green, blue |

Headers, extensions, ambiguities and decisions are in docs/formats/spz.md. Source: nianticlabs/spz.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

from gsplat_tools.chunks import CHUNK_SIZE, CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud, empty_cloud
from gsplat_tools.codecs.smallest_three import Rotation
from gsplat_tools.errors import CapabilityError, FormatError, GsplatWarning, LossyConversionWarning
from gsplat_tools.formats._issues import Issue, naming_rules
from gsplat_tools.formats.base import Bounds, FileInfo, Format, Scene
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.formats.spz import attributes, legacy, limits, streams
from gsplat_tools.formats.spz.header import (
    ANTIALIASED,
    COORDINATE_SYSTEM,
    FIRST_SMALLEST_THREE_VERSION,
    FIRST_ZSTD_VERSION,
    GZIP_MAGIC,
    MAGIC,
    MAX_SPLATS,
    WRITE_VERSIONS,
    Header,
    coordinate_record,
)
from gsplat_tools.formats.spz.payload import Payload
from gsplat_tools.formats.spz.rules import CODES, RULES, remarks
from gsplat_tools.parallel import blocks
from gsplat_tools.sequence import GaussianSequence

__all__ = ["FORMAT", "SpzOptions", "inspect", "matches", "read", "read_chunks", "write"]


DEFAULT_ZSTD_LEVEL, DEFAULT_ZLIB_LEVEL = 12, 6
"""Those of the format's own writer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpzOptions:
    """Choices of the writer.

    Parameters
    ----------
    version
        2, 3 or 4. 2 holds rotations in 24 bits and degree 3 at most.
    rotation
        Frame of each rotation: "reference" as the format's own encoder; "best" the smallest decoded error; "small" the
        frame with the smallest turn, which compresses best.
    sh1_bits, sh_rest_bits
        1 to 8 bits of SH values of band 1, and above; fewer compress better.
    fractional_bits
        Bits of a position behind the point; "auto" is 12, more for small scenes and fewer for large ones; "finest" is
        as many as fit.
    level
        Of zstd (version 4), 1 to 22, by default 12; of zlib (2 and 3), 1 to 9, more is taken for 9, by default 6.
    """

    version: int = 4
    rotation: Rotation = "small"
    sh1_bits: int = 5
    sh_rest_bits: int = 4
    fractional_bits: attributes.FractionalBits = "auto"
    level: int | None = None


def matches(head: bytes) -> bool:
    """Whether a file that starts with these bytes is SPZ."""
    return head.startswith(MAGIC) or (head.startswith(GZIP_MAGIC) and legacy.starts_with_header(head))


def _is_legacy(stream: BinaryIO) -> bool:
    """Whether the stream is compressed as a whole."""
    stream.seek(0)
    return stream.read(len(GZIP_MAGIC)) == GZIP_MAGIC


@naming_rules(CODES)
def inspect(stream: BinaryIO) -> FileInfo:
    """Return what the header and the extensions say.

    Raises
    ------
    FormatError
        They contradict themselves or the size of the file.
    """
    header = legacy.read_header(stream) if _is_legacy(stream) else streams.read_header(stream)[0]
    return FileInfo(
        version=str(header.version),
        splats=header.num_splats,
        sh_degree=header.sh_degree,
        coordinate_system=header.coordinate_system,
        splat_model=header.splat_model,
        encoding={
            "compression": "zstd" if header.version >= FIRST_ZSTD_VERSION else "gzip",
            "fractional_bits": header.fractional_bits,
            "position_step": 0.5**header.fractional_bits if header.version > 1 else None,
            "rotations": "smallest three" if header.version >= FIRST_SMALLEST_THREE_VERSION else "first three",
            "raw_bytes": header.raw_length(),
            "flags": header.flags,
            "extensions": [f"0x{kind:08x} ({len(payload)} bytes)" for kind, payload in header.extensions],
        },
    )


@naming_rules(CODES)
def _open(stream: BinaryIO, *, in_memory: bool) -> tuple[Header, Payload]:
    """Read everything but decode nothing; warn about extensions that are left out."""
    if _is_legacy(stream):
        header, payload = legacy.read(stream, in_memory=in_memory)
    else:
        header, places = streams.read_header(stream)
        payload = streams.read_payload(stream, header, places, in_memory=in_memory)
    others = [f"0x{kind:08x} ({len(data)} bytes)" for kind, data in header.extensions if kind != COORDINATE_SYSTEM]
    if others:
        warnings.warn(
            LossyConversionWarning(f"left out extensions: {', '.join(others)}", code="left-out-extensions"), stacklevel=3
        )
    return header, payload


def check(stream: BinaryIO) -> Iterator[Issue]:
    """Yield what is odd about a file that can be read; the reader says what is wrong with others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        try:
            header, payload = _open(stream, in_memory=False)
        except FormatError:
            return
    yield from remarks(header, payload)


def read(stream: BinaryIO, _options: Any = None) -> GaussianCloud:
    """Read the whole cloud.

    Raises
    ------
    FormatError
        The file contradicts itself, or does not decompress.

    Warns
    -----
    LossyConversionWarning
        Extensions other than the coordinate system were left out.
    """
    return attributes.decode_rows(*_open(stream, in_memory=True))


def read_chunks(stream: BinaryIO, _options: Any = None) -> CloudChunks:
    """Return the cloud in chunks; above 64 MiB the decompressed bytes wait in a temporary file.

    Raises
    ------
    FormatError
        The file contradicts itself, or does not decompress.

    Warns
    -----
    LossyConversionWarning
        Extensions other than the coordinate system were left out.
    """
    header, payload = _open(stream, in_memory=False)

    def iterate() -> Iterator[GaussianCloud]:
        for start, stop in blocks(header.num_splats, CHUNK_SIZE):
            yield attributes.decode_rows(header, {name: values[start:stop] for name, values in payload.items()})

    template = empty_cloud(0, header.sh_degree)
    model = "antialiased" if header.splat_model == "antialiased" else "default"
    template = template.replace(coordinate_system=header.coordinate_system, splat_model=model)
    return CloudChunks(header.num_splats, template, iterate)


def write(scene: Scene, stream: BinaryIO, options: SpzOptions) -> None:
    """Write a cloud or chunks, in the axes that they are in.

    Raises
    ------
    CapabilityError
        Positions do not fit, the degree is too high for the version, SPZ has no number for the coordinate system, the
        scene is a sequence or has too many splats.
    CloudError
        A value is not a number.

    Warns
    -----
    LossyConversionWarning
        Values out of range were clamped, or the scene is of flat splats, which SPZ does not tell.
    GsplatWarning
        Far splats make the steps of positions coarse.
    """
    if isinstance(scene, GaussianSequence):
        raise CapabilityError("an SPZ file holds one moment; choose one with --time or --frame")
    _check_options(options)
    chunks = as_chunks(scene)
    template = chunks.template
    if options.version < FIRST_SMALLEST_THREE_VERSION and chunks.sh_degree > 3:
        raise CapabilityError(f"SPZ {options.version} holds SH degree 3 at most; use version 3 or 4, or --sh-degree 3")
    if len(chunks) > MAX_SPLATS:
        raise CapabilityError(f"SPZ holds at most {MAX_SPLATS} splats, this scene has {len(chunks)}")
    extensions = coordinate_record(template.coordinate_system)
    if template.splat_model == "2dgs":
        warnings.warn(
            LossyConversionWarning(
                "SPZ does not tell flat splats from others: the splat model is dropped", code="dropped-splat-model"
            ),
            stacklevel=2,
        )
    header = Header(
        version=options.version,
        num_splats=len(chunks),
        sh_degree=chunks.sh_degree,
        fractional_bits=attributes.choose_fractional_bits(chunks, options.fractional_bits),
        flags=ANTIALIASED if template.splat_model == "antialiased" else 0,
    )
    how = attributes.Quantization(
        version=options.version,
        fractional_bits=header.fractional_bits,
        sh1_bits=options.sh1_bits,
        sh_rest_bits=options.sh_rest_bits,
        rotation=options.rotation,
    )
    tally = attributes.ClampTally()
    rows = attributes.encode_chunks(chunks, how, tally)
    if options.version >= FIRST_ZSTD_VERSION:
        streams.write(stream, header, extensions, rows, options.level or DEFAULT_ZSTD_LEVEL)
    else:
        legacy.write(stream, header, extensions, rows, min(options.level or DEFAULT_ZLIB_LEVEL, 9))
    tally.finish()


def _check_options(options: SpzOptions) -> None:
    """Refuse options out of range."""
    if options.version not in WRITE_VERSIONS:
        raise CapabilityError(f"SPZ is written in version 2, 3 or 4, not {options.version}; use --spz-version")
    for name in ("sh1_bits", "sh_rest_bits"):
        if not 1 <= getattr(options, name) <= 8:
            raise ValueError(f"{name} must be 1 to 8, got {getattr(options, name)}")
    bits = options.fractional_bits
    if not (bits in ("auto", "finest") or (isinstance(bits, int) and 0 <= bits <= attributes.FINEST_FRACTIONAL_BITS)):
        raise ValueError(f"fractional_bits must be 'auto', 'finest' or 0 to {attributes.FINEST_FRACTIONAL_BITS}, got {bits!r}")
    if options.level is not None and not 1 <= options.level <= 22:
        raise ValueError(f"level must be 1 to 22, got {options.level}")


def bounds(source: GaussianCloud, stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that the file's encoding allows for the splats of `source`."""
    found = limits.known(stream)
    if found is None:
        header, payload = _open(stream, in_memory=False)
        found = limits.remember(stream, header, payload.get("sh"))
    return limits.spz_bounds(source, *found)


FORMAT = Format(
    id="spz",
    title="SPZ (.spz)",
    extensions=(".spz",),
    spec="docs/formats/spz.md",
    max_sh_degree=4,
    matches=matches,
    inspect=inspect,
    read=read,
    read_chunks=read_chunks,
    write=write,
    bounds=bounds,
    check=check,
    rules=RULES,
    min_splats=1,  # the reference reader refuses a file without splats
    stores_coordinates=True,
    stores_splat_model=True,
    streams=True,
    position_type="fixed",
    write_options=SpzOptions,
    presets={
        "fast": {"level": 3},
        "balanced": {},
        "best": {
            "level": 19,
            "rotation": "best",
            "sh1_bits": 8,
            "sh_rest_bits": 8,
            "fractional_bits": "finest",
            "order": "morton",
        },
        "exact": {
            "level": 19,
            "rotation": "best",
            "sh1_bits": 8,
            "sh_rest_bits": 8,
            "fractional_bits": "finest",
        },
    },
    knobs={
        **general_knobs(4),
        "sh1_bits": Knob(values=tuple(range(1, 9)), stream="sh", graded=True, needs={"sh_degree": (1, 2, 3, 4)}),
        "sh_rest_bits": Knob(values=tuple(range(1, 9)), stream="sh", graded=True, needs={"sh_degree": (2, 3, 4)}),
        "fractional_bits": Knob(values=tuple(range(6, 24)), stream="positions", graded=True),
        "rotation": Knob(values=("small", "best"), stream="rotations"),
        "level": Knob(values=(3, 12, 19), stream="container"),
        "order": Knob(values=("none", "morton"), stream="container"),
    },
    model=("spark", None),
)
