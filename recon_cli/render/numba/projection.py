"""From raw parameters to ellipses on the image plane, LANES Gaussians at a time.

EWA splatting (Zwicker et al. 2002, eqs. 24 to 31; Kerbl et al. 2023, eq. 5): the covariance on the
image is V V^T + 0.3 I with V = J W R S, J the Jacobian of the pinhole projection at the mean.
Spherical harmonics are those of recon_cli.scene.harmonics (INRIA's 3DGS, after Sloan 2013,
"Efficient Spherical Harmonic Evaluation").
"""

from __future__ import annotations

import math

import numpy as np

from recon_cli.render.contract import CULL_SLACK, DILATION, NEAR
from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    absolute, bits, count_bits, exp2, fetch_add, fill, lane_numbers, load, log2, lowest_bit,
    maximum, minimum, square_root, store, transpose)
from recon_cli.render.numba.soa import (
    BLOCK, BLUE, DEPTH, EXTENT_X, EXTENT_Y, GREEN, HALF_Y, LOG2_E, LOG2_OPACITY, MEAN_X,
    MEAN_X_LOW, MEAN_Y, MEAN_Y_LOW, OUT, P_BASIS, P_DC, P_DX, P_DY, P_DZ, P_LOGIT, P_MEAN_X,
    P_MEAN_X_LOW, P_MEAN_Y, P_MEAN_Y_LOW, P_QW, P_QX, P_QY, P_QZ, P_REST, P_S0, P_S1, P_S2, P_Z,
    RECORD, RED, SLOPE_Y, SQUARE, TILE_HEIGHT, U_X, U_Y, V_Y, gather, image_axes, terms_of_group,
    unit_quaternion)

INFINITE = np.float32(3e38)
_F = np.float32
_SLACK = np.float32(CULL_SLACK)  # in q; culling keeps what rounding leaves in doubt
_LARGEST = np.float32(1e30)  # a determinant beyond it has no useful inverse
# spherical harmonics
C0 = np.float32(0.28209479177387814)
_C1 = np.float32(0.4886025119029199)
_C20, _C21, _C22 = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(
    0.5462742152960396)
_C30, _C31, _C32, _C33, _C34 = (np.float32(c) for c in (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277))


@kernel
def cull(counter, means, log_scales, logits, view, alpha_min, candidates, counts, broken, scratch):
    """Writes the ids that may be seen, block by block, and how many each block has.

    The largest axis bounds the half extent of the ellipse by sqrt(2 ln(1 / alpha_min) (s_max^2
    |J|^2 + 0.3)). What is not finite is not seen and counts as broken.
    """
    n = len(logits)
    blocks = (n + BLOCK - 1) // BLOCK
    f = _F(max(view.fx, view.fy))
    logit_min = _F(math.log(alpha_min / (1 - alpha_min)) - CULL_SLACK)
    # greatest 2 ln(o / alpha_min)
    reach = _F(-2 * math.log(alpha_min) * (1 + CULL_SLACK) + CULL_SLACK)
    R, bad = view.R, 0
    while True:
        block = fetch_add(counter, 0, 1)
        if block >= blocks:
            break
        to = block * BLOCK
        for first in range(block * BLOCK, min((block + 1) * BLOCK, n), LANES):
            count = min(LANES, n - first)
            for k in range(count):
                i = first + k
                x, y, z = means[3 * i], means[3 * i + 1], means[3 * i + 2]
                scratch[k] = _F(R[0] * x + R[1] * y + R[2] * z + view.t[0])
                scratch[LANES + k] = _F(R[3] * x + R[4] * y + R[5] * z + view.t[1])
                scratch[2 * LANES + k] = _F(R[6] * x + R[7] * y + R[8] * z + view.t[2])
                scratch[3 * LANES + k] = max(
                    log_scales[3 * i], max(log_scales[3 * i + 1], log_scales[3 * i + 2]))
                scratch[4 * LANES + k] = logits[i]
                scratch[5 * LANES + k] = (
                    log_scales[3 * i] + log_scales[3 * i + 1] + log_scales[3 * i + 2])
            x, y, z = load(scratch, 0), load(scratch, LANES), load(scratch, 2 * LANES)
            per_z = 1.0 / z
            u, v = x * per_z, y * per_z
            tan_x = minimum(maximum(u, _F(view.tan_left)), _F(view.tan_right))
            tan_y = minimum(maximum(v, _F(view.tan_top)), _F(view.tan_bottom))
            scale = exp2(minimum(maximum(load(scratch, 3 * LANES) * LOG2_E, -60.0), 60.0))
            jacobian = f * per_z * scale
            radius = square_root(reach * (
                jacobian * jacobian * (2.0 + tan_x * tan_x + tan_y * tan_y) + DILATION)) + 1.0
            mean_x, mean_y = u * _F(view.fx) + _F(view.cx), v * _F(view.fy) + _F(view.cy)
            valid = lane_numbers() < count
            finite = (absolute(x) + absolute(y) + absolute(z) + absolute(
                load(scratch, 4 * LANES)) + absolute(load(scratch, 5 * LANES)) < INFINITE)
            bad += count - count_bits(bits(finite & valid))
            visible = ((z > NEAR) & (load(scratch, 4 * LANES) >= logit_min)
                    & (mean_x + radius > 0.0) & (mean_x - radius < _F(view.width))
                    & (mean_y + radius > 0.0) & (mean_y - radius < _F(view.height))
                    & valid & finite)
            remaining = bits(visible)
            while remaining != 0:
                candidates[to] = first + lowest_bit(remaining)
                remaining &= remaining - np.uint64(1)
                to += 1
        counts[block] = to - block * BLOCK
    fetch_add(broken, 0, bad)


@kernel
def compact(candidates, counts, ids):
    """Writes the candidates of all blocks in a row, ascending."""
    to = 0
    for block in range(len(counts)):
        for k in range(counts[block]):
            ids[to] = candidates[block * BLOCK + k]
            to += 1


@kernel
def project(counter, ids, means, quats, log_scales, logits, sh_dc, sh_rest, stride, terms, view,
            alpha_min, records, depths, rows, radii, broken, scratch):
    """Writes record, depth (float64), rows of tiles and radius of every Gaussian in `ids`."""
    n = len(ids)
    blocks = (n + BLOCK - 1) // BLOCK
    tiles_y = (view.height + TILE_HEIGHT - 1) // TILE_HEIGHT
    bad = 0
    while True:
        block = fetch_add(counter, 0, 1)
        if block >= blocks:
            break
        for first in range(block * BLOCK, min((block + 1) * BLOCK, n), LANES):
            count = min(LANES, n - first)
            used = terms_of_group(ids, first, sh_rest, stride, terms)
            gather(scratch, ids, first, count, means, quats, log_scales, logits, sh_dc, sh_rest,
                   stride, used, view, depths)
            sound = shape(scratch, view, _F(alpha_min))
            sound &= (bits(colour(scratch, used)))
            for plane in range(0, RECORD, LANES):
                transpose(scratch, (OUT + plane) * LANES, scratch, SQUARE * LANES)
                for k in range(count):
                    store(records, (first + k) * RECORD + plane,
                          load(scratch, (SQUARE + k) * LANES))
            for k in range(count):
                j = first + k
                at = j * RECORD
                rows[2 * j] = 0
                rows[2 * j + 1] = 0
                if not (sound >> np.uint64(k)) & np.uint64(1):
                    bad += 1
                    continue
                mean_x, mean_y = records[at + MEAN_X], records[at + MEAN_Y]
                extent_x, extent_y = records[at + EXTENT_X], records[at + EXTENT_Y]
                if not (mean_x + extent_x > _F(0) and mean_x - extent_x < _F(view.width)):
                    continue
                top = max((mean_y - extent_y - _F(0.5)) / _F(TILE_HEIGHT), _F(0))
                bottom = min((mean_y + extent_y - _F(0.5)) / _F(TILE_HEIGHT), _F(tiles_y - 1))
                if bottom < _F(0) or top >= _F(tiles_y):
                    continue
                rows[2 * j] = np.int32(top)  # not negative: the cast rounds down
                rows[2 * j + 1] = np.int32(bottom) - rows[2 * j] + 1
                radii[ids[j]] = scratch[P_S0 * LANES + k]
    fetch_add(broken, 0, bad)


@inlined
def colour(scratch, terms):
    """Writes red, green and blue towards the camera; returns a mask of those that are numbers."""
    dx, dy, dz = load(scratch, P_DX * LANES), load(scratch, P_DY * LANES), load(
        scratch, P_DZ * LANES)
    per_length = 1.0 / square_root(maximum(dx * dx + dy * dy + dz * dz, 1e-37))
    write_basis(scratch, P_BASIS * LANES, dx * per_length, dy * per_length, dz * per_length, terms)
    red = C0 * load(scratch, P_DC * LANES) + 0.5
    green = C0 * load(scratch, (P_DC + 1) * LANES) + 0.5
    blue = C0 * load(scratch, (P_DC + 2) * LANES) + 0.5
    for k in range(terms):
        basis, at = load(scratch, (P_BASIS + k) * LANES), (P_REST + 3 * k) * LANES
        red = red + basis * load(scratch, at)
        green = green + basis * load(scratch, at + LANES)
        blue = blue + basis * load(scratch, at + 2 * LANES)
    store(scratch, (OUT + RED) * LANES, maximum(red, 0.0))
    store(scratch, (OUT + GREEN) * LANES, maximum(green, 0.0))
    store(scratch, (OUT + BLUE) * LANES, maximum(blue, 0.0))
    return absolute(red) + absolute(green) + absolute(blue) < INFINITE


@inlined
def factor(scratch, view):
    """Returns the rows of V = J W R S, [6]."""
    w, x, y, z, _ = unit_quaternion(scratch)
    ax, ay, az, bx, by, bz, _, _ = image_axes(scratch, view)
    s0 = exp2(minimum(maximum(load(scratch, P_S0 * LANES) * LOG2_E, -126.0), 126.0))
    s1 = exp2(minimum(maximum(load(scratch, P_S1 * LANES) * LOG2_E, -126.0), 126.0))
    s2 = exp2(minimum(maximum(load(scratch, P_S2 * LANES) * LOG2_E, -126.0), 126.0))
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r10, r11, r12 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r20, r21, r22 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    return ((ax * r00 + ay * r10 + az * r20) * s0, (ax * r01 + ay * r11 + az * r21) * s1,
            (ax * r02 + ay * r12 + az * r22) * s2, (bx * r00 + by * r10 + bz * r20) * s0,
            (bx * r01 + by * r11 + bz * r21) * s1, (bx * r02 + by * r12 + bz * r22) * s2)


@inlined
def shape(scratch, view, alpha_min):
    """Writes the ellipse of each lane; returns the bits of those that are sound."""
    v00, v01, v02, v10, v11, v12 = factor(scratch, view)
    a0, b = v00 * v00 + v01 * v01 + v02 * v02, v00 * v10 + v01 * v11 + v02 * v12
    c0 = v10 * v10 + v11 * v11 + v12 * v12
    a, c = a0 + DILATION, c0 + DILATION
    # a c - b^2 cancels for needles; |vx x vy|^2 does not (Lagrange), and it is never negative
    w0, w1, w2 = v01 * v12 - v02 * v11, v02 * v10 - v00 * v12, v00 * v11 - v01 * v10
    det = w0 * w0 + w1 * w1 + w2 * w2 + DILATION * (a0 + c0 + DILATION)
    logit = load(scratch, P_LOGIT * LANES)
    odds = exp2(minimum(-logit * LOG2_E, 126.0))
    log2_opacity = -log2(1.0 + odds)
    above = log2_opacity - log2(fill(alpha_min))
    reach = maximum(above, 0.0) * _F(2 / LOG2_E)  # 2 ln(o / alpha_min): 2 ln(255 o)
    reach = reach * (1.0 + _SLACK) + _SLACK
    per_c, per_a = 1.0 / c, 1.0 / a
    root = square_root(det * per_c)  # standard deviation along x at fixed y
    unit = _F(math.sqrt(LOG2_E / 2))
    u_x = unit / root
    extent_x, extent_y = square_root(reach * a), square_root(reach * c)
    slope_y, half_y = b * per_a, square_root(reach * det * per_a)
    mid, half = 0.5 * (a + c), 0.5 * (a - c)
    radius = 3.0 * square_root(mid + square_root(half * half + b * b))  # along the longer axis
    at = OUT * LANES
    mean_x, mean_y = load(scratch, P_MEAN_X * LANES), load(scratch, P_MEAN_Y * LANES)
    store(scratch, at + MEAN_X * LANES, mean_x)
    store(scratch, at + MEAN_Y * LANES, mean_y)
    store(scratch, at + U_X * LANES, u_x)
    store(scratch, at + U_Y * LANES, -b * per_c * u_x)
    store(scratch, at + V_Y * LANES, unit * square_root(per_c))
    store(scratch, at + LOG2_OPACITY * LANES, log2_opacity)
    store(scratch, at + DEPTH * LANES, load(scratch, P_Z * LANES))
    store(scratch, at + EXTENT_X * LANES, extent_x)
    store(scratch, at + EXTENT_Y * LANES, extent_y)
    store(scratch, at + SLOPE_Y * LANES, slope_y)
    store(scratch, at + HALF_Y * LANES, half_y)
    store(scratch, at + MEAN_X_LOW * LANES, load(scratch, P_MEAN_X_LOW * LANES))
    store(scratch, at + MEAN_Y_LOW * LANES, load(scratch, P_MEAN_Y_LOW * LANES))
    sum_of_all = (
        absolute(load(scratch, P_QW * LANES)) + absolute(load(scratch, P_QX * LANES))
        + absolute(load(scratch, P_QY * LANES)) + absolute(load(scratch, P_QZ * LANES))
        + absolute(load(scratch, P_S0 * LANES)) + absolute(load(scratch, P_S1 * LANES))
        + absolute(load(scratch, P_S2 * LANES)) + absolute(logit))
    store(scratch, P_S0 * LANES, radius)  # the plane is free now
    sound = ((sum_of_all < INFINITE) & (det < _LARGEST) & (det > 0.0)
             & (absolute(mean_x) < _LARGEST) & (absolute(mean_y) < _LARGEST)
             & (above >= 0.0))
    return bits(sound)


@inlined
def write_basis(to, at, x, y, z, terms):
    """Writes the first `terms` functions after the constant one to planes of `to` from `at` on."""
    if terms < 3:
        return
    store(to, at, -_C1 * y)
    store(to, at + LANES, _C1 * z)
    store(to, at + 2 * LANES, -_C1 * x)
    if terms < 8:
        return
    xx, yy, zz = x * x, y * y, z * z
    store(to, at + 3 * LANES, _C20 * x * y)
    store(to, at + 4 * LANES, -_C20 * y * z)
    store(to, at + 5 * LANES, _C21 * (2.0 * zz - xx - yy))
    store(to, at + 6 * LANES, -_C20 * x * z)
    store(to, at + 7 * LANES, _C22 * (xx - yy))
    if terms < 15:
        return
    store(to, at + 8 * LANES, -_C30 * y * (3.0 * xx - yy))
    store(to, at + 9 * LANES, _C31 * x * y * z)
    store(to, at + 10 * LANES, -_C32 * y * (4.0 * zz - xx - yy))
    store(to, at + 11 * LANES, _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
    store(to, at + 12 * LANES, -_C32 * x * (4.0 * zz - xx - yy))
    store(to, at + 13 * LANES, _C34 * z * (xx - yy))
    store(to, at + 14 * LANES, -_C30 * x * (xx - 3.0 * yy))


@inlined
def direction_gradient(pull, at, x, y, z, terms):
    """Returns the gradient of sum_k pull_k basis_k(x, y, z) by x, y, z, taken as independent.

    `pull` holds planes from `at` on.
    """
    p0, p1, p2 = load(pull, at), load(pull, at + LANES), load(pull, at + 2 * LANES)
    gx, gy, gz = -_C1 * p2, -_C1 * p0, _C1 * p1
    if terms >= 8:
        p3, p4, p5 = load(pull, at + 3 * LANES), load(pull, at + 4 * LANES), load(
            pull, at + 5 * LANES)
        p6, p7 = load(pull, at + 6 * LANES), load(pull, at + 7 * LANES)
        p5, p7 = 2.0 * _C21 * p5, 2.0 * _C22 * p7
        gx = gx + _C20 * (y * p3 - z * p6) - x * p5 + x * p7
        gy = gy + _C20 * (x * p3 - z * p4) - y * p5 - y * p7
        gz = gz - _C20 * (y * p4 + x * p6) + 2.0 * z * p5
    if terms >= 15:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        p8, p9, p10 = load(pull, at + 8 * LANES), load(pull, at + 9 * LANES), load(
            pull, at + 10 * LANES)
        p11, p12 = load(pull, at + 11 * LANES), load(pull, at + 12 * LANES)
        p13, p14 = load(pull, at + 13 * LANES), load(pull, at + 14 * LANES)
        p8, p9, p10, p11 = _C30 * p8, _C31 * p9, _C32 * p10, _C33 * p11
        p12, p13, p14 = _C32 * p12, _C34 * p13, 3.0 * _C30 * p14
        gx = (gx - 6.0 * xy * p8 + yz * p9 + 2.0 * xy * p10 - 6.0 * xz * p11
              - (4.0 * zz - 3.0 * xx - yy) * p12 + 2.0 * xz * p13 - (xx - yy) * p14)
        gy = (gy - 3.0 * (xx - yy) * p8 + xz * p9 - (4.0 * zz - xx - 3.0 * yy) * p10
              - 6.0 * yz * p11 + 2.0 * xy * p12 - 2.0 * yz * p13 + 2.0 * xy * p14)
        gz = (gz + xy * p9 - 8.0 * yz * p10 + (6.0 * zz - 3.0 * xx - 3.0 * yy) * p11
              - 8.0 * xz * p12 + (xx - yy) * p13)
    return gx, gy, gz
