"""Numbers fixed by a paper or a specification, each with its source."""

SH_C0 = 0.28209479177387814
"""Constant of the degree-0 SH basis, 1 / (2 sqrt(pi)); color = sh0 * SH_C0 + 0.5 (Kerbl et al. 2023)."""

MAX_SH_DEGREE = 4
"""Highest SH band that any supported format holds (SPZ 4, gsplat-unity)."""

VISIBLE_OPACITY = 1.0 / 255.0
"""Below this opacity no 8-bit target draws a splat (alpha cut-off of the 3DGS rasterizer, Kerbl et al. 2023)."""

TEMPORAL_CUTOFF = 0.01
"""Temporal weight below which a splat of the gaussian time model is hidden where a file says nothing (raiscui/gsplat-unity)."""
