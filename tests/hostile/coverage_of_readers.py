"""Branches of the readers that the hostile files reach: `python -m tests.hostile.coverage_of_readers`."""

from __future__ import annotations

import argparse
import sys
import tempfile
from itertools import chain
from pathlib import Path

import coverage

ROOT = Path(__file__).parents[2]
FORMATS = ROOT / "gsplat_tools" / "formats"

WRITERS = (
    *(
        "_atomic",
        "_files",
        "_folder",
        "_relaxing",
        "_stores",
        "base",
        "knobs",
        "loading",
        "preparing",
        "preparing_frames",
        "registry",
        "saving",
        "sequences",
    ),
    *("compressed_ply/writing", "ply/writing", "splat4d/options", "splat4d/writing", "spz/limits"),
    *("pack/arrays", "pack/container_writing", "pack/encoding", "pack/limits", "pack/spark", "pack/uncompressed", "pack/words"),
    *(f"sog/{name}" for name in ("bounds", "codebooks", "encode", "folder", "options", "relaxing")),
    *(f"sog4d/{name}" for name in ("bounds", "codebooks", "encode", "frame", "options", "relaxing", "repair", "segments")),
)
"""Modules that write, or that hold no parser; new ones count until they are named here."""

NOT_READING = (
    r"def (write|encode|quantize|choose|rotation_grid|bounds|compose|changes|repaired|meta_text)\w*\(",
    r"def _(check_quats|check\(cloud|palette_fields|write\()",
    r"def _(fitting|check_options|calibrate|clamped|rounding|stored_error|bounds|extents|half_steps|level_of|outside)\b",
    r"def _(box_to_json|warn_clamped|color_bound|compose\w*)\(",
    r"def (spz_bounds|half_step|facts_of|coordinate_record|comment_lines|publish\w*|remove_\w*|sweep_\w*|describe|to_json)\(",
    r"class (ZipWriter|BoxTally|ClampTally|RangeTally|Tally|SplatOptions|SpzOptions|GsccOptions|Quantization|Int8Options)\b",
    r"class (ModelOptions|BufferOptions)\b",
    r"\.\.\.$",
    r"if TYPE_CHECKING",
    r"def check\(cloud",
)
"""What else does not read: writers, bounds and options that share a module with a reader."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/reliability coverage", description=__doc__)
    parser.add_argument("--cases", type=int, default=3000, help="files a format (default 3000)")
    parser.add_argument("--format", action="append", help="only this one; may be repeated")
    parser.add_argument("--missing", action="store_true", help="show the lines and branches that were not reached")
    given = parser.parse_args()
    measured = coverage.Coverage(branch=True, source=[str(FORMATS)], data_file=None, config_file=False, omit=_omitted())
    for pattern in NOT_READING:
        measured.exclude(pattern)
    measured.start()
    _read_everything(given.cases, given.format)
    measured.stop()
    measured.report(show_missing=given.missing, skip_covered=True, file=sys.stdout)
    branches, taken = _branches(measured)
    print(f"branches of the readers: {taken} of {branches}, {100 * taken / branches:.1f} %")
    return int(taken < 0.95 * branches)


def _omitted() -> list[str]:
    return [str(FORMATS / f"{name}.py") for name in WRITERS] + [str(FORMATS / "__init__.py")]


def _read_everything(count: int, only: list[str] | None) -> None:
    """Judge seeds and a sample of every format; imported here, so that definitions count too."""
    from gsplat_tools.formats.registry import FORMATS as RECORDS
    from tests.hostile.cases import relatives, sample
    from tests.hostile.worker import judge_case, warm_up
    from tests.hostile.workplace import Workplace

    for format_id in only or [record.id for record in RECORDS.values() if record.read is not None]:
        with tempfile.TemporaryDirectory() as folder:
            place = Workplace(Path(folder))
            warm_up(format_id, place)
            for case in chain(relatives(format_id), sample(format_id, count)):
                judge_case(format_id, case, place)


def _branches(measured: coverage.Coverage) -> tuple[int, int]:
    """Return branches that there are, and those that were taken."""
    total, missing = 0, 0
    for path in measured.get_data().measured_files():
        numbers = measured._analyze(path).numbers
        total += numbers.n_branches
        missing += numbers.n_missing_branches
    return total, total - missing


if __name__ == "__main__":
    sys.exit(main())
