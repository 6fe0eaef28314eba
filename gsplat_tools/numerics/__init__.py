"""How exact every format is at the extremes: derived bounds beside measured errors, for synthetic sweeps or a scene."""

from gsplat_tools.numerics.measuring import Row, measure_cloud
from gsplat_tools.numerics.plots import plot_page, plot_svg
from gsplat_tools.numerics.report import exceeded_rows, scene_rows, summarize, synthetic_rows

__all__ = [
    "Row",
    "exceeded_rows",
    "measure_cloud",
    "plot_page",
    "plot_svg",
    "scene_rows",
    "summarize",
    "synthetic_rows",
]
