"""What both passes over a tile's pixels share: where pixels lie, and the alpha of a fragment.

As in the numba backend, with the projected covariance [[a, b], [b, c]] and d = pixel - mean,

    log2 alpha = log2 o - u^2 - v^2,   u = U_X dx + U_Y dy,   v = V_Y dy,

a sum of squares: nothing cancels in needles. The factors hold sqrt(log2(e) / 2). Within a tile
u and v are affine in column and row; what they are at the first pixel is a number of each instance
(`offsets`), taken in float64, because far from the mean of a needle its two terms nearly cancel.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

PIXELS = TILE * TILE
RECORD = 8  # floats a Gaussian: U_X, U_Y, V_Y, log2 o, red, green, blue, depth
SUMS = 16  # floats an instance, see `raster_backward.decompose`

LOG2_E = math.log2(math.e)
# Kernels see globals only as constants of this type.
SIDE = tl.constexpr(TILE)
AREA = tl.constexpr(PIXELS)
FLOATS = tl.constexpr(RECORD)
SLOT = tl.constexpr(SUMS)
LOG2_ALPHA_MIN = tl.constexpr(math.log2(ALPHA_MIN))
LOG2_ALPHA_MAX = tl.constexpr(math.log2(ALPHA_MAX))
LOG2E = tl.constexpr(LOG2_E)
UNIT = tl.constexpr(math.sqrt(LOG2_E / 2))
T_MIN = tl.constexpr(TRANSMITTANCE_MIN)


@triton.jit
def log2_alpha(record, offset, column, row):
    """Returns u, v and log2 alpha at pixels [256]: the same bits in both passes."""
    u = tl.fma(tl.load(record), column, tl.fma(tl.load(record + 1), row, tl.load(offset)))
    v = tl.fma(tl.load(record + 2), row, tl.load(offset + 1))
    power = tl.fma(-v, v, tl.fma(-u, u, tl.load(record + 3)))
    return u, v, power


@triton.jit
def alpha_of(power):
    """Returns alpha of log2 alpha; 0 where that is no fragment."""
    return tl.where(power >= LOG2_ALPHA_MIN, tl.exp2(tl.minimum(power, LOG2_ALPHA_MAX)), 0.0)
