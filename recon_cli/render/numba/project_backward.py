"""From sums over pixels to gradients of raw parameters: the projection's chain rule, reversed.

With V = J W R S and Sigma' = V V^T + 0.3 I: dL/dV = 2 dL/dSigma' V, and so on down to the raw
parameters. The forward pass is computed again: cheaper than to keep it.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.contract import DILATION
from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.render.numba.projection import C0, direction_gradient, write_basis
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    exp2, fetch_add, fill, fma, load, maximum, minimum, select, square_root, store, transpose)
from recon_cli.render.numba.soa import (
    BLOCK, BLUE, COUNT, GRAD_BLUE, GRAD_DEPTH, GRAD_GREEN, GRAD_RED, GREEN,
    LEAVE_ONE_OUT, LOG2_E, P_BASIS, P_DX, P_DY, P_DZ, P_LOGIT, P_REST, P_S0, P_S1, P_S2, P_X, P_Y,
    P_Z, PROJECTION_FLOATS, RECORD, RED, S_SQUARED, S_U, S_UU, S_UV, S_V, S_VV, SLOT, SQUARE, U_X,
    U_Y, V_Y, S, gather, image_axes, planes_to_rows, terms_of_group, unit_quaternion)

_F = np.float32
_WHITE = _F(2 / LOG2_E)  # u and v hold sqrt(log2(e) / 2)
_WHITE_2 = _WHITE * _WHITE
# planes behind those of the projection
_SUMS = PROJECTION_FLOATS // LANES
_RECORD = _SUMS + SLOT
_GRAD = _RECORD + RECORD  # mean 3, quaternion 4, scales 3, logit 1, base colour 3, rest 45
G_MEAN, G_QUAT, G_SCALE, G_LOGIT, G_DC, G_REST = (_GRAD + i for i in (0, 3, 7, 10, 11, 14))
G_MEAN2D, G_VARIANCE = (_GRAD + 59 + i for i in (0, 2))
_PULL = _GRAD + 64
GRADIENT_FLOATS = (_PULL + 15) * LANES


@kernel
def project_backward(counter, ids, block_starts, slot_start, sums, depths, means, quats, log_scales,
                     logits, sh_dc, sh_rest, stride, terms, harmonics, view, records, g_means,
                     g_quats, g_log_scales, g_logits, g_sh_dc, g_sh_rest, means2d_grad,
                     variance, loo, scratch):
    """Writes the gradients of all Gaussians, zero for those that were not seen.

    Without `harmonics`, g_sh_rest is left alone.
    """
    n = len(logits)
    blocks = len(block_starts) - 1
    while True:
        block = fetch_add(counter, 0, 1)
        if block >= blocks:
            break
        low, high = block * BLOCK, min((block + 1) * BLOCK, n)
        clear(g_means, 3 * low, 3 * high)
        clear(g_quats, 4 * low, 4 * high)
        clear(g_log_scales, 3 * low, 3 * high)
        clear(g_logits, low, high)
        clear(g_sh_dc, 3 * low, 3 * high)
        if harmonics and terms > 0:
            clear(g_sh_rest, min(stride * low, len(sh_rest)), min(stride * high, len(sh_rest)))
        clear(means2d_grad, 2 * low, 2 * high)
        clear(variance, low, high)
        clear(loo, low, high)
        for first in range(block_starts[block], block_starts[block + 1], LANES):
            count = min(LANES, block_starts[block + 1] - first)
            any_slot = slot_start[first + count] > slot_start[first]
            if not any_slot:
                continue
            used = terms_of_group(ids, first, sh_rest, stride, terms)
            gather(scratch, ids, first, count, means, quats, log_scales, logits, sh_dc, sh_rest,
                   stride, used, view, depths)
            for plane in range(0, SLOT, LANES):
                for k in range(LANES):
                    j = first + min(k, count - 1)
                    summed = fill(0.0)
                    for slot in range(slot_start[j], slot_start[j + 1]):
                        summed = summed + load(sums, slot * SLOT + plane)
                    store(scratch, (SQUARE + k) * LANES, summed)
                transpose(scratch, SQUARE * LANES, scratch, (_SUMS + plane) * LANES)
                for k in range(LANES):
                    j = first + min(k, count - 1)
                    store(scratch, (SQUARE + k) * LANES, load(records, j * RECORD + plane))
                transpose(scratch, SQUARE * LANES, scratch, (_RECORD + plane) * LANES)
            colour_gradient(scratch, used, harmonics)
            shape_gradient(scratch, view)
            for k in range(count):
                j = first + k
                if slot_start[j + 1] == slot_start[j]:
                    continue
                i = np.int64(ids[j])
                for c in range(3):
                    g_means[3 * i + c] = scratch[(G_MEAN + c) * LANES + k]
                    g_log_scales[3 * i + c] = scratch[(G_SCALE + c) * LANES + k]
                    g_sh_dc[3 * i + c] = scratch[(G_DC + c) * LANES + k]
                for c in range(4):
                    g_quats[4 * i + c] = scratch[(G_QUAT + c) * LANES + k]
                g_logits[i] = scratch[G_LOGIT * LANES + k]
                for c in range(2):
                    means2d_grad[2 * i + c] = scratch[(G_MEAN2D + c) * LANES + k]
                variance[i] = scratch[G_VARIANCE * LANES + k]
                loo[i] = scratch[(_SUMS + LEAVE_ONE_OUT) * LANES + k]
            if harmonics and used > 0:
                planes_to_rows(scratch, G_REST, SQUARE, used, ids, first, count, slot_start,
                               g_sh_rest, stride)


@inlined
def clear(array, low, high):
    """Writes zeros to array[low:high]."""
    i = low
    while i + LANES <= high:
        store(array, i, fill(0.0))
        i += LANES
    while i < high:
        array[i] = _F(0)
        i += 1


@inlined
def plane(scratch, number):
    """Returns one number of all lanes."""
    return load(scratch, number * LANES)


@inlined
def colour_gradient(scratch, terms, harmonics):
    """Writes the gradients of the coefficients, and into G_MEAN what the direction pulls."""
    red = select(plane(scratch, _RECORD + RED) > 0.0, plane(scratch, _SUMS + GRAD_RED), 0.0)
    green = select(plane(scratch, _RECORD + GREEN) > 0.0, plane(scratch, _SUMS + GRAD_GREEN), 0.0)
    blue = select(plane(scratch, _RECORD + BLUE) > 0.0, plane(scratch, _SUMS + GRAD_BLUE), 0.0)
    store(scratch, G_DC * LANES, C0 * red)
    store(scratch, (G_DC + 1) * LANES, C0 * green)
    store(scratch, (G_DC + 2) * LANES, C0 * blue)
    if terms == 0:
        for c in range(3):
            store(scratch, (G_MEAN + c) * LANES, 0.0 * red)
        return
    for k in range(3 * terms, 45 if harmonics else 0):  # degrees that are not in use
        store(scratch, (G_REST + k) * LANES, fill(0.0))
    dx, dy, dz = plane(scratch, P_DX), plane(scratch, P_DY), plane(scratch, P_DZ)
    per_length = 1.0 / square_root(maximum(dx * dx + dy * dy + dz * dz, 1e-37))
    x, y, z = dx * per_length, dy * per_length, dz * per_length
    write_basis(scratch, P_BASIS * LANES, x, y, z, terms)
    for k in range(terms):
        if harmonics:
            basis, at = plane(scratch, P_BASIS + k), G_REST + 3 * k
            store(scratch, at * LANES, basis * red)
            store(scratch, (at + 1) * LANES, basis * green)
            store(scratch, (at + 2) * LANES, basis * blue)
        at = P_REST + 3 * k
        store(scratch, (_PULL + k) * LANES, fma(red, plane(scratch, at), fma(
            green, plane(scratch, at + 1), blue * plane(scratch, at + 2))))
    gx, gy, gz = direction_gradient(scratch, _PULL * LANES, x, y, z, terms)
    along = gx * x + gy * y + gz * z  # the direction has length 1 whatever the mean does
    store(scratch, G_MEAN * LANES, (gx - along * x) * per_length)
    store(scratch, (G_MEAN + 1) * LANES, (gy - along * y) * per_length)
    store(scratch, (G_MEAN + 2) * LANES, (gz - along * z) * per_length)


@inlined
def shape_gradient(scratch, view):
    """Writes the gradients of mean, rotation, scales and opacity, and the statistics."""
    u_x, u_y, v_y = (plane(scratch, _RECORD + U_X), plane(scratch, _RECORD + U_Y),
                     plane(scratch, _RECORD + V_Y))
    s_u, s_v = plane(scratch, _SUMS + S_U), plane(scratch, _SUMS + S_V)
    s_uu, s_uv = plane(scratch, _SUMS + S_UU), plane(scratch, _SUMS + S_UV)
    s_vv, s = plane(scratch, _SUMS + S_VV), plane(scratch, _SUMS + S)
    # dL/dmean' = sum s y, y = Sigma'^-1 d = L (u, v)
    d_x, d_y = _WHITE * (u_x * s_u), _WHITE * (u_y * s_u + v_y * s_v)
    store(scratch, G_MEAN2D * LANES, d_x)
    store(scratch, (G_MEAN2D + 1) * LANES, d_y)
    hits = maximum(plane(scratch, _SUMS + COUNT), 1.0)
    store(scratch, G_VARIANCE * LANES,
          maximum(plane(scratch, _SUMS + S_SQUARED) - s * s / hits, 0.0))
    odds = exp2(minimum(-plane(scratch, P_LOGIT) * LOG2_E, 126.0))  # (1 - o) / o
    store(scratch, G_LOGIT * LANES, s * odds / (1.0 + odds))

    w, x, y, z, per_length = unit_quaternion(scratch)
    ax, ay, az, bx, by, bz, _, _ = image_axes(scratch, view)
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r10, r11, r12 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r20, r21, r22 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    ma0, ma1, ma2, mb0, mb1, mb2 = (
        ax * r00 + ay * r10 + az * r20, ax * r01 + ay * r11 + az * r21,
        ax * r02 + ay * r12 + az * r22, bx * r00 + by * r10 + bz * r20,
        bx * r01 + by * r11 + bz * r21, bx * r02 + by * r12 + bz * r22)  # J W R
    # dL/dSigma' = 1/2 L M L^T, M the moments of (u, v), so that dL/dV = L M (P, Q) with
    # (P, Q) = L^T V. P = U_X (c vx - b vy) / c cancels for needles; c vx - b vy =
    # .3 vx + vy x (vx x vy) does not.
    t0, t1, t2 = scale_of(scratch, P_S0), scale_of(scratch, P_S1), scale_of(scratch, P_S2)
    vx0, vx1, vx2, vy0, vy1, vy2 = ma0 * t0, ma1 * t1, ma2 * t2, mb0 * t0, mb1 * t1, mb2 * t2
    w0, w1, w2 = vx1 * vy2 - vx2 * vy1, vx2 * vy0 - vx0 * vy2, vx0 * vy1 - vx1 * vy0
    per_c = _WHITE * v_y * v_y
    p0 = u_x * per_c * (DILATION * vx0 + (vy1 * w2 - vy2 * w1))
    p1 = u_x * per_c * (DILATION * vx1 + (vy2 * w0 - vy0 * w2))
    p2 = u_x * per_c * (DILATION * vx2 + (vy0 * w1 - vy1 * w0))
    q0, q1, q2 = v_y * vy0, v_y * vy1, v_y * vy2
    m0, n0 = _WHITE_2 * (s_uu * p0 + s_uv * q0), _WHITE_2 * (s_uv * p0 + s_vv * q0)
    m1, n1 = _WHITE_2 * (s_uu * p1 + s_uv * q1), _WHITE_2 * (s_uv * p1 + s_vv * q1)
    m2, n2 = _WHITE_2 * (s_uu * p2 + s_uv * q2), _WHITE_2 * (s_uv * p2 + s_vv * q2)
    g_0, g_1, g_2 = m0 * p0 + n0 * q0, m1 * p1 + n1 * q1, m2 * p2 + n2 * q2
    store(scratch, G_SCALE * LANES, g_0)
    store(scratch, (G_SCALE + 1) * LANES, g_1)
    store(scratch, (G_SCALE + 2) * LANES, g_2)
    # gradients of the two rows of J W R
    e0, e1, e2 = t0 * u_x * m0, t1 * u_x * m1, t2 * u_x * m2
    f0, f1, f2 = t0 * (u_y * m0 + v_y * n0), t1 * (u_y * m1 + v_y * n1), t2 * (u_y * m2 + v_y * n2)
    d00, d01, d02 = ax * e0 + bx * f0, ax * e1 + bx * f1, ax * e2 + bx * f2  # dL/dR
    d10, d11, d12 = ay * e0 + by * f0, ay * e1 + by * f1, ay * e2 + by * f2
    d20, d21, d22 = az * e0 + bz * f0, az * e1 + bz * f1, az * e2 + bz * f2
    gw = 2.0 * (x * (d21 - d12) + y * (d02 - d20) + z * (d10 - d01))
    gx = 2.0 * (y * (d01 + d10) + z * (d02 + d20) - 2.0 * x * (d11 + d22) + w * (d21 - d12))
    gy = 2.0 * (x * (d01 + d10) + z * (d12 + d21) - 2.0 * y * (d00 + d22) + w * (d02 - d20))
    gz = 2.0 * (x * (d02 + d20) + y * (d12 + d21) - 2.0 * z * (d00 + d11) + w * (d10 - d01))
    along = gw * w + gx * x + gy * y + gz * z
    store(scratch, G_QUAT * LANES, (gw - along * w) * per_length)
    store(scratch, (G_QUAT + 1) * LANES, (gx - along * x) * per_length)
    store(scratch, (G_QUAT + 2) * LANES, (gy - along * y) * per_length)
    store(scratch, (G_QUAT + 3) * LANES, (gz - along * z) * per_length)

    # the axes of the image: a = fx / z (R0 - tan_x R2), b = fy / z (R1 - tan_y R2)
    h0, h1, h2 = e0 * r00 + e1 * r01 + e2 * r02, e0 * r10 + e1 * r11 + e2 * r12, (
        e0 * r20 + e1 * r21 + e2 * r22)
    i0, i1, i2 = f0 * r00 + f1 * r01 + f2 * r02, f0 * r10 + f1 * r11 + f2 * r12, (
        f0 * r20 + f1 * r21 + f2 * r22)
    R = view.R
    per_z = 1.0 / plane(scratch, P_Z)
    fx_z, fy_z = _F(view.fx) * per_z, _F(view.fy) * per_z
    d_tan_x = -fx_z * (h0 * _F(R[6]) + h1 * _F(R[7]) + h2 * _F(R[8]))
    d_tan_y = -fy_z * (i0 * _F(R[6]) + i1 * _F(R[7]) + i2 * _F(R[8]))
    d_z = -per_z * (g_0 + g_1 + g_2)  # both rows are proportional to 1 / z
    u, v = plane(scratch, P_X) * per_z, plane(scratch, P_Y) * per_z
    held_x = (u >= _F(view.tan_left)) & (u <= _F(view.tan_right))
    held_y = (v >= _F(view.tan_top)) & (v <= _F(view.tan_bottom))
    d_u = select(held_x, d_tan_x, 0.0) + _F(view.fx) * d_x
    d_v = select(held_y, d_tan_y, 0.0) + _F(view.fy) * d_y
    d_z = d_z - per_z * (u * d_u + v * d_v) + plane(scratch, _SUMS + GRAD_DEPTH)
    d_u, d_v = d_u * per_z, d_v * per_z
    for c in range(3):
        store(scratch, (G_MEAN + c) * LANES, plane(scratch, G_MEAN + c) + (
            _F(R[c]) * d_u + _F(R[3 + c]) * d_v + _F(R[6 + c]) * d_z))


@inlined
def scale_of(scratch, number):
    """Returns the standard deviations along one axis."""
    return exp2(minimum(maximum(plane(scratch, number) * LOG2_E, -126.0), 126.0))
