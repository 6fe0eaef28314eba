"""Positions of the numbers that describe a camera and a rendering model in the arrays that kernels read.

`reference.models` fills them; kernels know rules, never models. LENS and RULES are float arrays of the type that is
computed in, CHOICES are integers.
"""

# LENS: the camera, in the space of the means
VIEW = 0  # 12 numbers: rows of the rotation, each followed by its translation
FX, FY, CX, CY = 12, 13, 14, 15  # px
WIDTH, HEIGHT = 16, 17  # px
SLOPE_X, SLOPE_Y = 18, 19  # tan(fov / 2)
Z_MIN, Z_MAX = 20, 21  # only depths strictly between are drawn
LENS_SIZE = 22

# RULES: a model's numbers
LOW_PASS = 0  # px^2 added to both diagonals of the covariance
SLOPE_LIMIT = 1  # x/z and y/z are clamped to this many tan(fov / 2) in the Jacobian
CENTER_LIMIT = 2  # culled where abs(ndc) of the center is above
AXIS_CAP = 3  # longest axis, px, as the square root of 2 lambda
SMALLEST = 4  # culled where lambda1 is below, px^2
ALPHA_CAP = 5
ALPHA_FLOOR = 6  # fragments below are skipped
CUTOFF = 7  # fragments beyond this q are skipped; q = d^2 / 2, d in standard deviations
GAIN, OFFSET = 8, 9  # falloff = gain exp(-q) - offset
EDGE_GAIN, EDGE_START, EDGE_SLOPE = 10, 11, 12  # less gain exp((m - start) slope), m = max(abs u, abs v) at the unit quad
SCALE_FACTOR = 13  # of the quad
COMPENSATION_FLOOR = 14  # least ratio of determinants under the root
COLOR_FLOOR = 15
BRIGHTNESS = 16
STOP = 17  # a pixel is finished before its transmittance falls below
ROUNDING = 18  # 1.5 * 2^(bits of the mantissa): adding and subtracting it rounds to an integer
RULES_SIZE = 19

# CHOICES: a model's alternatives
COMPENSATION = 0
FOOTPRINT = 1
AXES = 2
IN_AXES = 3  # falloff and quad are evaluated in the splat's axes
GAMMA = 4  # colors are turned from gamma to linear
IS_FRONT_TO_BACK = 5
IS_QUANTIZED = 6  # framebuffer of 8 bits
SQUARE_PIXELS = 7  # the focal length of x serves both rows of the Jacobian
CULLS_EXTENT = 8  # culled where abs(ndc) less the longest axis is above 1
CHOICES_SIZE = 9

COMPENSATION_NONE, COMPENSATION_RATIO = 0, 1
FOOTPRINT_ELLIPSE, FOOTPRINT_TILES = 0, 1
AXES_EXACT, AXES_UNDEFINED, AXES_ALIGNED = 0, 1, 2
"""What happens where the eigenvector (b, lambda1 - a) degenerates: nothing, counted, or b below 0.001 counts as 0."""

# Columns of a splat in world space
MEAN, SCALE, QUAT, OPACITY, COLOR = 0, 3, 6, 10, 11
SPLAT_SIZE = 14

# Columns of a projected splat: q = (S dx + K dy)^2 + (H dy)^2 = (UX dx + UY dy)^2 + (VX dx + VY dy)^2
REC_X, REC_Y = 0, 1
REC_S, REC_K, REC_H = 2, 3, 4
REC_Q = 5  # nothing is drawn beyond this q
REC_OPACITY = 6
REC_R, REC_G, REC_B = 7, 8, 9
REC_UX, REC_UY, REC_VX, REC_VY = 10, 11, 12, 13
REC_BOX = 14  # half side of the quad, in units of sqrt(q)
RECORD_SIZE = 16  # padded to a cache line of float32

# States of a splat after projection
DRAWN, CULLED, INVALID, HIDDEN = 0, 1, 2, 3
EIGENVECTOR_UNDEFINED = 128  # added to DRAWN
