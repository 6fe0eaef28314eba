"""File formats: one module or folder each, one record each; they never import each other."""

from gsplat_tools.formats._limits import use_max_memory
from gsplat_tools.formats._store_requests import use_store_timeout
from gsplat_tools.formats.loading import inspect_file, load
from gsplat_tools.formats.registry import FORMATS, detect, find_format
from gsplat_tools.formats.saving import SaveReport, save

__all__ = [
    "FORMATS",
    "SaveReport",
    "detect",
    "find_format",
    "inspect_file",
    "load",
    "save",
    "use_max_memory",
    "use_store_timeout",
]
