"""File formats: one module or folder each, one record each; they never import each other."""

from gsplat_tools.formats.registry import FORMATS, detect, find_format

__all__ = ["FORMATS", "detect", "find_format"]
