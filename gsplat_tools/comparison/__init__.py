"""How far one scene is from another: errors per attribute against derived bounds, and rendered pictures."""

from gsplat_tools.comparison.attributes import AttributeTally, attribute_errors, match_splats, paired
from gsplat_tools.comparison.rendered import (
    ComparisonReport,
    ViewReport,
    common_frames,
    compare,
    compare_rendered,
    frame_levels,
    sample,
    still,
)

__all__ = [
    "AttributeTally",
    "ComparisonReport",
    "ViewReport",
    "attribute_errors",
    "common_frames",
    "compare",
    "compare_rendered",
    "frame_levels",
    "match_splats",
    "paired",
    "sample",
    "still",
]
