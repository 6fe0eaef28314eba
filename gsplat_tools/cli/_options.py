"""Click options and types that the commands share; choices of formats are read from the registry."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gsplat_tools.attributes.coordinate_systems import is_known
from gsplat_tools.formats._limits import use_max_memory
from gsplat_tools.formats._store_requests import DEFAULT_STORE_TIMEOUT, TRIES, use_store_timeout
from gsplat_tools.formats.registry import FORMATS

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

EXISTING_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
MODELS = ("inria", "unity", "spark", "visionary")


# click's types take a parameter from 8.4 on only, and older versions serve as well.
if TYPE_CHECKING:
    SizeBase = click.ParamType[tuple[int, int]]
    WordOrIntBase = click.ParamType[int | str]
    TimesBase = click.ParamType[list[float]]
    AxesBase = click.ParamType[str]
    FloatBase = click.ParamType[float]
    ClipBase = click.ParamType[float | str]
    BytesBase = click.ParamType[int]
else:
    SizeBase = WordOrIntBase = TimesBase = AxesBase = click.ParamType
    FloatBase = ClipBase = BytesBase = click.ParamType


class AxesType(AxesBase):
    """Three axis letters."""

    name = "AXES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the letters in capitals."""
        axes = str(value).upper()
        if not is_known(axes):
            self.fail(f"{value!r} is not three axis letters such as RUB, RDF, RUF or LUF", param, ctx)
        return axes


class FiniteType(FloatBase):
    """A finite number, in a range if one is given."""

    name = "NUMBER"

    def __init__(self, low: float = -math.inf, high: float = math.inf) -> None:
        self._low = low
        self._high = high

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or not self._low <= number <= self._high:
            wanted = "a number" if math.isinf(self._low) else f"a number from {self._low:g} to {self._high:g}"
            self.fail(f"{value!r} is not {wanted}", param, ctx)
        return number


class SizeType(SizeBase):
    """WxH in pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Return (width, height)."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", str(value))
        if not match or "0" in match.groups():
            self.fail(f"{value!r} is not a size such as 1280x720", param, ctx)
        return int(match[1]), int(match[2])


class DegreeType(WordOrIntBase):
    """0 to 4, or auto."""

    name = "0..4|auto"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """Return the degree or "auto"."""
        if value == "auto":
            return "auto"
        if str(value) not in {"0", "1", "2", "3", "4"}:
            self.fail(f"{value!r} is not 0 to 4 or auto", param, ctx)
        return int(value)


class FractionalBitsType(WordOrIntBase):
    """0 to 23, auto or finest."""

    name = "0..23|auto|finest"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """Return the number of bits, or the word."""
        if value in {"auto", "finest"}:
            return str(value)
        if not (str(value).isdecimal() and int(value) <= 23):
            self.fail(f"{value!r} is not 0 to 23, auto or finest", param, ctx)
        return int(value)


class ClipType(ClipBase):
    """0 to below 0.5, auto or rendered."""

    name = "SHARE|auto|rendered"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Return the share, or the word."""
        if value in {"auto", "rendered"}:
            return str(value)
        try:
            share = float(value)
        except ValueError:
            share = math.nan
        if not 0 <= share < 0.5:
            self.fail(f"{value!r} is not a share from 0 to below 0.5, auto or rendered", param, ctx)
        return share


class PositionBitsType(click.Choice):  # type: ignore[type-arg]
    """8 or 16."""

    def __init__(self) -> None:
        super().__init__(["8", "16"])

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the bits."""
        return int(super().convert(str(value), param, ctx))


class FramesType(WordOrIntBase):
    """A number of frames, or auto."""

    name = "N|auto"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """Return the number or "auto"."""
        if value == "auto":
            return "auto"
        if not re.fullmatch(r"[1-9]\d{0,5}", str(value)):
            self.fail(f"{value!r} is not a number of frames or auto", param, ctx)
        return int(value)


class BytesType(BytesBase):
    """A number of bytes, with or without a unit."""

    name = "SIZE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the bytes."""
        match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?(?:([KMGT])(?:i?B)?|B)?", str(value).strip(), re.IGNORECASE)
        size = 0 if match is None else int(float(match[1]) * 1024 ** " KMGT".index((match[2] or " ").upper()))
        if size < 1:
            self.fail(f"{value!r} is not a size such as 512M or 4G", param, ctx)
        return size


class FrameTimesType(TimesBase):
    """A comma-separated list, or a file of one number a line."""

    name = "FILE|LIST"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[float]:
        """Return the times."""
        if isinstance(value, list):
            return value
        text = Path(value).read_text(encoding="utf-8") if Path(value).is_file() else str(value)
        try:
            return [float(word) for word in re.split(r"[,\s]+", text.strip()) if word]
        except ValueError:
            self.fail(f"{value!r} is neither a file of numbers nor a list such as 0,0.5,1", param, ctx)


def format_ids(capability: str) -> list[str]:
    """Return the ids of formats that can `read` or `write`."""
    return [record.id for record in FORMATS.values() if getattr(record, capability) is not None]


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --json."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")(function)


def progress_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --progress/--no-progress."""
    return click.option("--progress/--no-progress", default=True, help="Show what takes longer than a second, on stderr.")(
        function
    )


def jobs_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --jobs."""
    return click.option("--jobs", type=click.IntRange(min=1), help="Threads to use; the result does not depend on it.")(
        function
    )


def max_memory_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --max-memory, which holds until the command ends."""

    def limit(ctx: click.Context, _param: click.Parameter, value: int | None) -> None:
        if value is not None:
            ctx.with_resource(use_max_memory(value))

    return click.option(
        "--max-memory",
        type=BytesType(),
        expose_value=False,
        callback=limit,
        help="Most bytes that the splats of a source may take, such as 4G; by default 1024 times its file.",
    )(function)


def store_timeout_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --store-timeout, which holds until the command ends, for its workers too."""

    def limit(ctx: click.Context, _param: click.Parameter, value: float | None) -> None:
        if value is not None:
            ctx.with_resource(use_store_timeout(value))

    return click.option(
        "--store-timeout",
        type=FiniteType(0.1, 86400),
        metavar="SECONDS",
        expose_value=False,
        callback=limit,
        help=f"How long a store (s3://, gs://) may take to answer a request, which is tried {TRIES} times; "
        f"by default GSPLAT_STORE_TIMEOUT, or {DEFAULT_STORE_TIMEOUT:g}.",
    )(function)


def version_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --version, which also names the WebP library that images are made with."""

    def show(ctx: click.Context, _param: click.Parameter, value: bool) -> None:
        if not value or ctx.resilient_parsing:
            return
        from PIL import features

        import gsplat_tools

        click.echo(f"gsplat_tools {gsplat_tools.__version__} (libwebp {features.version('webp') or 'missing'})")
        ctx.exit()

    return click.option(
        "--version", is_flag=True, expose_value=False, is_eager=True, callback=show, help="Show the version and exit."
    )(function)
