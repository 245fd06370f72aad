"""Where things lie in the flat arrays that kernels share: the record of a Gaussian, tiles, batches.

A visible Gaussian is 16 numbers, one cache line. With the projected covariance [[a, b], [b, c]]
and d = pixel - mean the kernels evaluate

    log2 alpha = log2 o - u^2 - v^2,   u = U_X dx + U_Y dy,   v = V_Y dy,

the quadratic form as a sum of squares: nothing cancels in needles, and v is the same along a row
of pixels. The factors hold sqrt(log2(e) / 2), so that alpha is a power of two.
"""

from __future__ import annotations

import math

from recon_cli.render.numba.lanes import LANES

TILE_WIDTH = LANES  # one vector is one row of pixels of a tile
TILE_HEIGHT = 16
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT

RECORD = 16  # floats a Gaussian
MEAN_X, MEAN_Y = 0, 1  # pixels
U_X, U_Y, V_Y = 2, 3, 4
LOG2_OPACITY = 5
RED, GREEN, BLUE, DEPTH = 6, 7, 8, 9
# The ellipse alpha = 1/255 in its bounding box, for culling: at an offset dx the ellipse covers
# SLOPE_Y dx -+ HALF_Y sqrt(1 - (dx / EXTENT_X)^2), and the same with x and y exchanged.
# With x and y exchanged the slope is b / c = -U_Y / U_X and the half EXTENT_Y V_Y / U_X.
EXTENT_X, EXTENT_Y = 10, 11
SLOPE_Y, HALF_Y = 12, 13  # b / a; pixels
# What float32 drops of the mean: at 640 pixels it is 3e-5, and decides who reaches alpha = 1/255.
MEAN_X_LOW, MEAN_Y_LOW = 14, 15

FAR = 1e9  # pixels; the half of an ellipse that only its box cuts

BATCH = 32  # instances of a tile that are prepared at a time

# What the backward pass sums over the pixels of an instance, one slot of 16 numbers for each;
# s = alpha dL/dalpha.
SLOT = 16
(GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_DEPTH, S, S_U, S_V, S_UU, S_UV, S_VV,
 ABS_X, ABS_Y, S_SQUARED, COUNT, LEAVE_ONE_OUT) = range(15)

LOG2_E = math.log2(math.e)
LOG2_ALPHA_MAX = math.log2(0.99)
