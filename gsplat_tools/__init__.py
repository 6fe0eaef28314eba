"""Convert, inspect and validate Gaussian splat assets.

`import gsplat_tools` is instant: what needs compiled kernels is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gsplat_tools._version import __version__ as __version__

if TYPE_CHECKING:
    from gsplat_tools import errors
    from gsplat_tools.cloud import GaussianCloud
    from gsplat_tools.comparison import compare
    from gsplat_tools.errors import GsplatError, GsplatWarning
    from gsplat_tools.formats import FORMATS, load, save, use_max_memory, use_store_timeout
    from gsplat_tools.formats.sequences import open_sequence
    from gsplat_tools.reference.camera import Camera
    from gsplat_tools.reference.rasterizer import render
    from gsplat_tools.reference.sorting import sort_by_depth
    from gsplat_tools.sequence import GaussianSequence

_HOMES = {
    "FORMATS": "gsplat_tools.formats",
    "GsplatError": "gsplat_tools.errors",
    "GsplatWarning": "gsplat_tools.errors",
    "Camera": "gsplat_tools.reference.camera",
    "GaussianCloud": "gsplat_tools.cloud",
    "GaussianSequence": "gsplat_tools.sequence",
    "compare": "gsplat_tools.comparison",
    "load": "gsplat_tools.formats",
    "open_sequence": "gsplat_tools.formats.sequences",
    "render": "gsplat_tools.reference.rasterizer",
    "save": "gsplat_tools.formats",
    "sort_by_depth": "gsplat_tools.reference.sorting",
    "use_max_memory": "gsplat_tools.formats",
    "use_store_timeout": "gsplat_tools.formats",
}

__all__ = [
    "FORMATS",
    "Camera",
    "GaussianCloud",
    "GaussianSequence",
    "GsplatError",
    "GsplatWarning",
    "compare",
    "errors",
    "load",
    "open_sequence",
    "render",
    "save",
    "sort_by_depth",
    "use_max_memory",
    "use_store_timeout",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its home on first use."""
    if name == "errors":
        return import_module("gsplat_tools.errors")
    if name not in _HOMES:
        raise AttributeError(f"module 'gsplat_tools' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
