"""The layouts that kernels share: records, slots, and structures of arrays of LANES Gaussians.

In scratch each quantity of a group of LANES Gaussians is a plane, one vector: raw parameters are
gathered into planes, rows of higher SH coefficients transposed both ways. Rows are `stride` numbers
long, 9, 24 or 45, no multiple of LANES, and only the first Gaussians have one. Nothing is read or
written behind the last row.
"""

from __future__ import annotations

import math

import numpy as np

from recon_cli.kernels.kernel import inlined
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    absolute, fill, load, maximum, minimum, select, square_root, store, transpose)

TILE_WIDTH, TILE_HEIGHT = 2 * LANES, 16
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# One vector is a patch of pixels: an ellipse of 8 x 8 pixels meets 8 patches of 4 x 4, but 12 rows
# of 16. Pixels of a tile lie patch by patch, along four rows of eight patches.
PATCH_WIDTH, PATCH_HEIGHT = LANES // 4, 4
PATCHES_X, PATCHES_Y = TILE_WIDTH // PATCH_WIDTH, TILE_HEIGHT // PATCH_HEIGHT
PATCHES = PATCHES_X * PATCHES_Y  # 32 whatever LANES is: a bit each

# Floats of a Gaussian. Means are in pixels; the low part is what float32 drops: at 640 pixels
# it is 3e-5, and decides who reaches alpha = 1/255. EXTENT, SLOPE and HALF are of the ellipse
# alpha = 1/255 in its bounding box, for culling: at an offset dx it covers
# SLOPE_Y dx -+ HALF_Y sqrt(1 - (dx / EXTENT_X)^2), where SLOPE_Y is b / a. With x and y exchanged
# the slope is b / c = -U_Y / U_X and the half EXTENT_Y V_Y / U_X.
RECORD = 16
(MEAN_X, MEAN_Y, U_X, U_Y, V_Y, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_X, EXTENT_Y,
 SLOPE_Y, HALF_Y, MEAN_X_LOW, MEAN_Y_LOW) = range(RECORD)

FAR = 1e9  # pixels; half of an ellipse so large that only its box cuts
BATCH = 64  # instances of a tile that are prepared at a time, a bit each

# What the backward pass sums over the pixels of an instance, in its slot; s = alpha dL/dalpha.
SLOT = 16
(GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_DEPTH, S, S_U, S_V, S_UU, S_UV, S_VV,
 S_SQUARED, COUNT, LEAVE_ONE_OUT) = range(13)

LOG2_E = math.log2(math.e)
LOG2_ALPHA_MAX = math.log2(0.99)

BLOCK = 1024  # Gaussians that a thread takes at a time
_F = np.float32


# planes of a group of LANES Gaussians in scratch
(P_X, P_Y, P_Z, P_MEAN_X, P_MEAN_Y, P_QW, P_QX, P_QY, P_QZ, P_S0, P_S1, P_S2, P_LOGIT,
 P_DX, P_DY, P_DZ, P_MEAN_X_LOW, P_MEAN_Y_LOW, P_DC) = range(19)
P_REST = P_DC + 3
P_BASIS = P_REST + 45
OUT = P_BASIS + 15
SQUARE = OUT + RECORD  # LANES planes in which blocks are turned
PROJECTION_FLOATS = (SQUARE + LANES) * LANES


@inlined
def gather(scratch, ids, first, count, means, quats, log_scales, logits, sh_dc, sh_rest, stride,
           terms, view, depths):
    """Fills the planes of `scratch` with Gaussians ids[first : first + count], `depths` too."""
    R = view.R
    for k in range(LANES):
        i = np.int64(ids[first + min(k, count - 1)])
        x, y, z = (np.float64(means[3 * i]), np.float64(means[3 * i + 1]),
                   np.float64(means[3 * i + 2]))
        # in float64: an error of the mean in pixels is an error of every alpha
        to_x = R[0] * x + R[1] * y + R[2] * z + view.t[0]
        to_y = R[3] * x + R[4] * y + R[5] * z + view.t[1]
        to_z = R[6] * x + R[7] * y + R[8] * z + view.t[2]
        scratch[P_X * LANES + k] = to_x
        scratch[P_Y * LANES + k] = to_y
        scratch[P_Z * LANES + k] = to_z
        if k < count:
            depths[first + k] = to_z
        mean_x, mean_y = view.fx * to_x / to_z + view.cx, view.fy * to_y / to_z + view.cy
        scratch[P_MEAN_X * LANES + k] = mean_x
        scratch[P_MEAN_Y * LANES + k] = mean_y
        scratch[P_MEAN_X_LOW * LANES + k] = mean_x - scratch[P_MEAN_X * LANES + k]
        scratch[P_MEAN_Y_LOW * LANES + k] = mean_y - scratch[P_MEAN_Y * LANES + k]
        scratch[P_DX * LANES + k] = x - view.center[0]
        scratch[P_DY * LANES + k] = y - view.center[1]
        scratch[P_DZ * LANES + k] = z - view.center[2]
        for c in range(4):
            scratch[(P_QW + c) * LANES + k] = quats[4 * i + c]
        for c in range(3):
            scratch[(P_S0 + c) * LANES + k] = log_scales[3 * i + c]
            scratch[(P_DC + c) * LANES + k] = sh_dc[3 * i + c]
        scratch[P_LOGIT * LANES + k] = logits[i]
    if terms > 0:
        rows_to_planes(sh_rest, stride, ids, first, count, terms, scratch, P_REST, SQUARE)


@inlined
def unit_quaternion(scratch):
    """Returns w, x, y, z of length 1, and the factor of a gradient.

    The largest entry is divided out first: small squares vanish. Zeros: no rotation, no gradient.
    """
    w, x = load(scratch, P_QW * LANES), load(scratch, P_QX * LANES)
    y, z = load(scratch, P_QY * LANES), load(scratch, P_QZ * LANES)
    top = maximum(maximum(absolute(w), absolute(x)), maximum(absolute(y), absolute(z)))
    nonzero = top > 1e-30
    top = select(nonzero, top, 1.0)
    per_top = 1.0 / top
    w, x, y, z = w * per_top, x * per_top, y * per_top, z * per_top
    w = select(nonzero, w, 1.0)
    per_length = 1.0 / square_root(w * w + x * x + y * y + z * z)
    return (w * per_length, x * per_length, y * per_length, z * per_length,
            select(nonzero, per_length * per_top, 0.0))


@inlined
def image_axes(scratch, view):
    """Returns the rows of J W, [6], and the clamped x/z and y/z.

    At grazing angles the linearisation blows up: x/z and y/z are held near the image (INRIA 3DGS).
    """
    per_z = 1.0 / load(scratch, P_Z * LANES)
    u, v = load(scratch, P_X * LANES) * per_z, load(scratch, P_Y * LANES) * per_z
    u = minimum(maximum(u, _F(view.tan_left)), _F(view.tan_right))
    v = minimum(maximum(v, _F(view.tan_top)), _F(view.tan_bottom))
    R = view.R
    x, y = _F(view.fx) * per_z, _F(view.fy) * per_z
    return (x * (_F(R[0]) - u * _F(R[6])), x * (_F(R[1]) - u * _F(R[7])),
            x * (_F(R[2]) - u * _F(R[8])), y * (_F(R[3]) - v * _F(R[6])),
            y * (_F(R[4]) - v * _F(R[7])), y * (_F(R[5]) - v * _F(R[8])), u, v)


@inlined
def terms_of_group(ids, first, sh_rest, stride, terms):
    """Returns how many higher SH terms a group uses; ids ascend, those without any come last."""
    return terms if stride * np.int64(ids[first]) < len(sh_rest) else 0


@inlined
def rows_to_planes(sh_rest, stride, ids, first, count, terms, scratch, plane, spare):
    """Fills planes from `plane` on with coefficients, zeros where a Gaussian has none.

    LANES planes from `spare` on are overwritten.
    """
    if stride < LANES:  # a vector would reach beyond the row, and behind the last one there is none
        for k in range(LANES):
            row = stride * np.int64(ids[first + min(k, count - 1)])
            for c in range(3 * terms):
                scratch[(plane + c) * LANES + k] = (
                    sh_rest[row + c] if row < len(sh_rest) else np.float32(0))
        return
    for block in range(0, 3 * terms, LANES):
        at = min(block, stride - LANES)
        for k in range(LANES):
            row = stride * np.int64(ids[first + min(k, count - 1)])
            if row < len(sh_rest):
                store(scratch, (spare + k) * LANES, load(sh_rest, row + at))
            else:
                store(scratch, (spare + k) * LANES, fill(0.0))
        transpose(scratch, spare * LANES, scratch, (plane + at) * LANES)


@inlined
def planes_to_rows(scratch, plane, spare, terms, ids, first, count, slot_start, sh_rest, stride):
    """Writes planes from `plane` on to the rows of those that were seen and have coefficients."""
    if stride < LANES:
        for k in range(count):
            row = stride * np.int64(ids[first + k])
            if row < len(sh_rest) and slot_start[first + k + 1] > slot_start[first + k]:
                for c in range(3 * terms):
                    sh_rest[row + c] = scratch[(plane + c) * LANES + k]
        return
    for block in range(0, 3 * terms, LANES):
        at = min(block, stride - LANES)
        transpose(scratch, (plane + at) * LANES, scratch, spare * LANES)
        for k in range(count):
            row = stride * np.int64(ids[first + k])
            if row < len(sh_rest) and slot_start[first + k + 1] > slot_start[first + k]:
                store(sh_rest, row + at, load(scratch, (spare + k) * LANES))
