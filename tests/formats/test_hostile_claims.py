"""Headers that claim too much, names that a terminal would obey, and the limit that a caller sets."""

from __future__ import annotations

import io
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
import zstandard
from click.testing import CliRunner

import gsplat_tools
from gsplat_tools.errors import CorruptDataError, FormatError, GsplatError, GsplatWarning, LimitExceededError
from gsplat_tools.formats import FORMATS, use_max_memory
from gsplat_tools.formats import _limits as limits
from gsplat_tools.formats.ply import inspect as inspect_ply
from gsplat_tools.formats.ply import read as read_ply
from gsplat_tools.formats.spz import read as read_spz
from tests.builders import PlyElement, ply_file, splat_columns
from tests.builders_spz import SpzFile, random_file
from tests.clouds import random_cloud
from tests.formats.sog_files import archive, edited, version_2
from tests.hostile.corpus import seal_gspk, written_files
from tests.sog4d_bundles import archive as sog4d_archive
from tests.sog4d_bundles import valid_files, valid_meta

WINDOW_OF_128_MIB = bytes.fromhex("28b52ffd00") + bytes([17 << 3])
"""Start of a zstd frame that does not say what it holds."""


def test_claim__is_held_against_the_file_or_the_callers_limit() -> None:
    limits.check_claim(limits.ALWAYS_READ, 10, field="count")
    limits.check_claim(1024 * 100_000, 100_000, field="count")
    with pytest.raises(LimitExceededError, match=r"102400001 decoded .* 100000 stored .* 1024 times.*--max-memory"):
        limits.check_claim(1024 * 100_000 + 1, 100_000, field="count")

    with use_max_memory(5000):
        limits.check_claim(5000, 1, field="count")
        with pytest.raises(LimitExceededError, match="more than the 5000 allowed"):
            limits.check_claim(5001, 1 << 20, field="count")
    limits.check_claim(5001, 1 << 20, field="count")


def test_limit__reaches_the_threads_that_read_frames() -> None:
    from concurrent.futures import ThreadPoolExecutor

    with use_max_memory(77), ThreadPoolExecutor(1) as pool:
        assert pool.submit(limits.max_memory).result() == 77
    assert limits.max_memory() is None
    with pytest.raises(ValueError, match="at least 1"), use_max_memory(0):
        pass


@pytest.mark.parametrize("format_id", [record.id for record in FORMATS.values() if record.read and record.write])
def test_limit__holds_for_every_format(format_id: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene{FORMATS[format_id].extensions[0]}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        gsplat_tools.save(random_cloud(5, sh_degree=1), path, to=format_id)

    with use_max_memory(100), pytest.raises(LimitExceededError, match="--max-memory") as caught:
        gsplat_tools.load(path)
    assert caught.value.field is not None

    with use_max_memory(5 * limits.splat_bytes(4, has_motion=True)), warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        gsplat_tools.load(path)


def test_property_count__does_not_make_a_header_slow() -> None:
    columns: dict[str, Any] = splat_columns(1, 0) | {f"p{i}": ("uchar", [1]) for i in range(30_000)}
    data = ply_file(PlyElement("vertex", columns))
    start = time.process_time()

    assert len(inspect_ply(io.BytesIO(data)).encoding["extras"]) == 30_000
    assert len(read_ply(io.BytesIO(data)).extra) == 30_000

    assert time.process_time() - start < 20  # it was minutes; quadratic in the properties


def test_first_line_without_end__is_read_no_further_than_a_header() -> None:
    class Counting(io.BytesIO):
        total = 0

        def read(self, size: int | None = -1) -> bytes:
            data = super().read(size)
            self.total += len(data)
            return data

    stream = Counting(b"ply" + b" " * (8 << 20))
    with pytest.raises(FormatError):
        read_ply(stream)
    assert stream.total <= 4 << 20


def test_zstd_window__is_no_larger_than_the_stream_can_use() -> None:
    file = random_file(3, version=4)
    data = file.data()
    alphas = WINDOW_OF_128_MIB + (3 << 3 | 1).to_bytes(3, "little") + b"abc"
    frames = [zstandard.compress(file.positions), alphas, *map(zstandard.compress, (file.colors, file.scales, file.rotations))]
    lengths = [27, 3, 9, 9, 12]
    table = b"".join(len(f).to_bytes(8, "little") + n.to_bytes(8, "little") for f, n in zip(frames, lengths, strict=True))

    with pytest.raises(CorruptDataError, match="memory") as caught:
        read_spz(io.BytesIO(data[:32] + table + b"".join(frames)))
    assert caught.value.field == "alphas"


def test_splats_that_are_all_alike__are_read_up_to_16_mib_and_beyond_with_leave() -> None:
    def alike(count: int) -> bytes:
        parts = {"positions": 9, "alphas": 1, "colors": 3, "scales": 3, "rotations": 4}
        return SpzFile(**{name: bytes(width * count) for name, width in parts.items()}).data()  # type: ignore[arg-type]

    assert len(read_spz(io.BytesIO(alike(200_000)))) == 200_000
    with pytest.raises(LimitExceededError, match="--max-memory"):
        read_spz(io.BytesIO(alike(400_000)))
    with use_max_memory(1 << 30):
        assert len(read_spz(io.BytesIO(alike(400_000)))) == 400_000


def test_gspk_description_beyond_the_end_of_numbers__is_refused() -> None:
    data = bytearray(written_files(FORMATS["spark"], {"sh_degree": 1})[0])
    data[16:32] = (1 << 63).to_bytes(8, "little") + bytes(8)

    with pytest.raises(CorruptDataError) as caught:
        FORMATS["spark"].inspect(io.BytesIO(seal_gspk(bytes(data))))
    assert caught.value.field == "json_offset"


def test_number_beyond_float32__is_refused_without_a_warning() -> None:
    meta = valid_meta()
    meta["streams"]["sh"]["sh0Codebook"][7] = 1e308

    with pytest.raises(CorruptDataError, match="finite"):
        FORMATS["sog4d"].inspect(io.BytesIO(sog4d_archive(meta, valid_files())))


def test_repair_that_fails__leaves_no_archive_behind() -> None:
    import gc

    files = valid_files()
    data = bytearray(sog4d_archive(valid_meta(), files))
    data[data.index(b"sh/centroids.bin") + 20] ^= 0xFF  # the CRC no longer fits
    target = io.BytesIO()

    with pytest.raises(CorruptDataError, match="does not decompress"):
        FORMATS["sog4d"].repair(io.BytesIO(bytes(data)), target)  # type: ignore[misc]
    target.close()
    gc.collect()  # pytest reports what is raised in here


def test_error__shows_hostile_names_so_that_a_terminal_does_not_obey() -> None:
    error = CorruptDataError("found \x1b[2Jx\ud800 " + "y" * 5000, field="a\x1b]0;b\u202e" + "z" * 500)

    assert str(error).isprintable()
    assert len(str(error)) < 1200
    assert "\\x1b[2Jx\\ud800" in str(error)
    str(error).encode()
    assert str(GsplatWarning("a\x1bb")) == "a\\x1bb"
    assert str(GsplatError("two\nlines")) == "two\nlines"


@pytest.mark.parametrize("flags", [[], ["--json"]])
def test_info__shows_hostile_names_as_text(flags: list[str], tmp_path: Path) -> None:
    from gsplat_tools.cli.inspect import main

    path = tmp_path / "scene.sog"
    path.write_bytes(archive(edited(version_2(0), "asset.generator", "\x1b[31m\ud800 and \u202e")))

    result = CliRunner().invoke(main, ["info", str(path), *flags])

    assert result.exit_code == 0, result.output
    assert "\x1b" not in result.output
    assert "\\ud800" in result.output


def test_max_memory__is_an_option_of_the_commands(tmp_path: Path) -> None:
    from gsplat_tools.cli.convert import main as convert
    from gsplat_tools.cli.inspect import main as inspect

    path = tmp_path / "scene.ply"
    path.write_bytes(ply_file(PlyElement("vertex", splat_columns(300, 1))))

    refused = CliRunner().invoke(inspect, ["stats", str(path), "--max-memory", "10K"])
    assert refused.exit_code == 1
    assert "vertex, byte" in refused.stderr
    assert "more than the 10240 allowed" in refused.stderr
    assert CliRunner().invoke(inspect, ["stats", str(path), "--max-memory", "0.1 GiB"]).exit_code == 0
    refused = CliRunner().invoke(convert, [str(path), str(tmp_path / "scene.gspk"), "--max-memory", "10000"])
    assert refused.exit_code == 1
    assert not (tmp_path / "scene.gspk").exists()
    assert limits.max_memory() is None
    for size in ("0", "many", "-1", "1X"):
        assert CliRunner().invoke(inspect, ["stats", str(path), "--max-memory", size]).exit_code == 2
