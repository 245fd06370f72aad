"""From sums over instances to gradients of raw parameters: the projection's chain rule, reversed.

With V = J W R S and Sigma' = V V^T + 0.3 I, L^T L the inverse of Sigma', M = sum s (u, v)(u, v)^T
and P = L V, which is of order one: dL/dV = L^T M P and dL/dlog s = diag(P^T M P). By way of
dL/dSigma' the gradient of a needle would cancel by the square of its length in pixels. The forward
pass is computed again: cheaper than to keep it.
"""

from __future__ import annotations

import triton
import triton.language as tl

from recon_cli.render.triton.compositing import FLOATS, LOG2E, SLOT, UNIT
from recon_cli.render.triton.gaussian import (
    BOTTOM,
    C0,
    FX,
    FY,
    LEFT,
    RIGHT,
    TOP,
    basis,
    direction,
    image_axes,
    number,
    position,
    project_axes,
    rotation,
    slope,
    standard_deviations,
    unit_quaternion,
)
from recon_cli.render.triton.projection import LOW_PASS

AT_ONCE = tl.constexpr(4)  # slots; a Gaussian as large as the image has thousands
WHITE = tl.constexpr(1.0 / UNIT.value)  # u and v hold sqrt(log2(e) / 2)


@triton.jit
def sums_of(starts, sums, count, counted, GATED: tl.constexpr, PLAIN: tl.constexpr,
            DETAILS: tl.constexpr, SCORES: tl.constexpr, BLOCK: tl.constexpr):
    """Returns the sums [BLOCK, SLOT] over the slots of each Gaussian, in order.

    Four lanes read a slot, side by side: one lane would go to memory once for each number.
    """
    i = (tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK))[:, None]
    slot = tl.load(starts + i, mask=i < count, other=0)
    end = tl.load(starts + i + 1, mask=i < count, other=0)
    if GATED:
        end = tl.where(tl.load(counted) != 0, end, slot)
    column = tl.arange(0, SLOT)[None, :]
    used = column < 10
    if PLAIN:
        used = used & (column != 3)
    if DETAILS:
        used = used | (column == 10) | (column == 11)
    if SCORES:
        used = used | (column == 12)
    total = tl.zeros([BLOCK, SLOT], tl.float32)
    while tl.max(end - slot) > 0:
        # several at once: their loads wait together
        for _ in tl.static_range(AT_ONCE):
            total += tl.load(sums + slot.to(tl.int64) * SLOT + column, mask=(slot < end) & used,
                             other=0.0)
            slot += 1
    return total


@triton.jit
def part(total, place: tl.constexpr):
    """Returns a column [BLOCK] of [BLOCK, SLOT]."""
    return tl.sum(tl.where(tl.arange(0, SLOT)[None, :] == place, total, 0.0), 1)


@triton.jit(do_not_specialize=("count", "colored"))
def project_backward(means, quats, log_scales, logits, sh_rest, view, count, colored, records,
                     starts, sums, counted, g_means, g_quats, g_log_scales, g_logits, g_sh_dc,
                     directions, means2d_grad, variance, loo, STRIDE: tl.constexpr,
                     TERMS: tl.constexpr, GATED: tl.constexpr, PLAIN: tl.constexpr,
                     DETAILS: tl.constexpr, SCORES: tl.constexpr, BLOCK: tl.constexpr):
    """Writes the gradients of all Gaussians but that of sh_rest, zero for those no pixel shows.

    `sums` [E, SLOT] are of `compositing.composite_backward`. Written are the gradients `g_*`, with
    TERMS the directions [N, 3] from the camera, and the statistics, see `contract.Statistics`:
    variance with DETAILS, loo with SCORES. With GATED all are zero where `counted` [1] int32 is.
    With PLAIN `sums` hold nothing of depths.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    slot, end = tl.load(starts + i, mask=here, other=0), tl.load(starts + i + 1, mask=here, other=0)
    if GATED:
        end = tl.where(tl.load(counted) != 0, end, slot)
    drawn = slot < end
    total = sums_of(starts, sums, count, counted, GATED, PLAIN, DETAILS, SCORES, BLOCK)
    red, green, blue, depth = part(total, 0), part(total, 1), part(total, 2), part(total, 3)
    s, s_u, s_v = part(total, 4), part(total, 5), part(total, 6)
    s_uu, s_uv, s_vv = part(total, 7), part(total, 8), part(total, 9)
    if DETAILS:
        squared, hits = part(total, 10), part(total, 11)
    if SCORES:
        left_out = part(total, 12)
    zero = s * 0.0
    record = records + i * FLOATS
    red = tl.where(tl.load(record + 4, mask=drawn, other=0.0) > 0.0, red, 0.0)
    green = tl.where(tl.load(record + 5, mask=drawn, other=0.0) > 0.0, green, 0.0)
    blue = tl.where(tl.load(record + 6, mask=drawn, other=0.0) > 0.0, blue, 0.0)
    tl.store(g_sh_dc + 3 * i, red * C0, mask=here)
    tl.store(g_sh_dc + 3 * i + 1, green * C0, mask=here)
    tl.store(g_sh_dc + 3 * i + 2, blue * C0, mask=here)
    pull_x, pull_y, pull_z = zero, zero, zero
    if TERMS > 0:
        x, y, z, per_length = direction(means, view, i, drawn)
        has, row = drawn & (i < colored), STRIDE * i
        tl.store(directions + 3 * i, x, mask=here)
        tl.store(directions + 3 * i + 1, y, mask=here)
        tl.store(directions + 3 * i + 2, z, mask=here)
        for k in tl.static_range(TERMS):
            pull = (red * tl.load(sh_rest + row + 3 * k, mask=has, other=0.0)
                    + green * tl.load(sh_rest + row + 3 * k + 1, mask=has, other=0.0)
                    + blue * tl.load(sh_rest + row + 3 * k + 2, mask=has, other=0.0))
            to_x, to_y, to_z = slope(k, x, y, z)
            pull_x += pull * to_x
            pull_y += pull * to_y
            pull_z += pull * to_z
        along = pull_x * x + pull_y * y + pull_z * z  # the direction has length 1
        pull_x = (pull_x - along * x) * per_length
        pull_y = (pull_y - along * y) * per_length
        pull_z = (pull_z - along * z) * per_length

    u_x = tl.load(record, mask=drawn, other=0.0) * WHITE
    u_y = tl.load(record + 1, mask=drawn, other=0.0) * WHITE
    v_y = tl.load(record + 2, mask=drawn, other=0.0) * WHITE
    s_u, s_v = s_u * WHITE, s_v * WHITE
    s_uu, s_uv, s_vv = s_uu * (WHITE * WHITE), s_uv * (WHITE * WHITE), s_vv * (WHITE * WHITE)
    # dL/dmean' = sum s y, y = Sigma'^-1 d = L^T (u, v)
    d_x, d_y = u_x * s_u, u_y * s_u + v_y * s_v
    tl.store(means2d_grad + 2 * i, d_x, mask=here)
    tl.store(means2d_grad + 2 * i + 1, d_y, mask=here)
    if DETAILS:
        spread = squared.to(tl.float64) - s.to(tl.float64) * s / tl.maximum(hits, 1.0)
        tl.store(variance + i, tl.maximum(spread, 0.0).to(tl.float32), mask=here)
    if SCORES:
        tl.store(loo + i, left_out, mask=here)
    odds = tl.exp2(tl.minimum(-tl.load(logits + i, mask=drawn, other=0.0) * LOG2E, 126.0))
    tl.store(g_logits + i, s * (odds / (1.0 + odds)), mask=here)  # o dL/do (1 - o)

    to_x, to_y, to_z = position(means, view, i, drawn)
    to_z = tl.where(drawn, to_z, 1.0)
    per_z = (1.0 / to_z).to(tl.float32)
    u, v = (to_x / to_z).to(tl.float32), (to_y / to_z).to(tl.float32)
    a0, a1, a2, b0, b1, b2 = image_axes(view, u, v, per_z)
    w, x, y, z, per_norm = unit_quaternion(quats, i, drawn)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(w, x, y, z)
    t0, t1, t2 = standard_deviations(log_scales, i, drawn)
    v00, v01, v02 = project_axes(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    v10, v11, v12 = project_axes(b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    v00, v01, v02, v10, v11, v12 = v00 * t0, v01 * t1, v02 * t2, v10 * t0, v11 * t1, v12 * t2
    # P = U_X (c vx - b vy) / c cancels; c vx - b vy = .3 vx + vy x (vx x vy) does not
    w0, w1, w2 = v01 * v12 - v02 * v11, v02 * v10 - v00 * v12, v00 * v11 - v01 * v10
    scale = u_x * v_y * v_y
    p0 = scale * (v00 * LOW_PASS + (v11 * w2 - v12 * w1))
    p1 = scale * (v01 * LOW_PASS + (v12 * w0 - v10 * w2))
    p2 = scale * (v02 * LOW_PASS + (v10 * w1 - v11 * w0))
    q0, q1, q2 = v_y * v10, v_y * v11, v_y * v12
    m0, n0 = s_uu * p0 + s_uv * q0, s_uv * p0 + s_vv * q0
    m1, n1 = s_uu * p1 + s_uv * q1, s_uv * p1 + s_vv * q1
    m2, n2 = s_uu * p2 + s_uv * q2, s_uv * p2 + s_vv * q2
    g0, g1, g2 = m0 * p0 + n0 * q0, m1 * p1 + n1 * q1, m2 * p2 + n2 * q2
    tl.store(g_log_scales + 3 * i, g0, mask=here)
    tl.store(g_log_scales + 3 * i + 1, g1, mask=here)
    tl.store(g_log_scales + 3 * i + 2, g2, mask=here)
    # gradients of the two rows of J W R
    e0, e1, e2 = t0 * u_x * m0, t1 * u_x * m1, t2 * u_x * m2
    f0, f1 = t0 * (u_y * m0 + v_y * n0), t1 * (u_y * m1 + v_y * n1)
    f2 = t2 * (u_y * m2 + v_y * n2)
    d00, d01, d02 = a0 * e0 + b0 * f0, a0 * e1 + b0 * f1, a0 * e2 + b0 * f2  # dL/dR
    d10, d11, d12 = a1 * e0 + b1 * f0, a1 * e1 + b1 * f1, a1 * e2 + b1 * f2
    d20, d21, d22 = a2 * e0 + b2 * f0, a2 * e1 + b2 * f1, a2 * e2 + b2 * f2
    gw = 2.0 * (x * (d21 - d12) + y * (d02 - d20) + z * (d10 - d01))
    gx = 2.0 * (y * (d01 + d10) + z * (d02 + d20) - 2.0 * x * (d11 + d22) + w * (d21 - d12))
    gy = 2.0 * (x * (d01 + d10) + z * (d12 + d21) - 2.0 * y * (d00 + d22) + w * (d02 - d20))
    gz = 2.0 * (x * (d02 + d20) + y * (d12 + d21) - 2.0 * z * (d00 + d11) + w * (d10 - d01))
    along = gw * w + gx * x + gy * y + gz * z
    tl.store(g_quats + 4 * i, (gw - along * w) * per_norm, mask=here)
    tl.store(g_quats + 4 * i + 1, (gx - along * x) * per_norm, mask=here)
    tl.store(g_quats + 4 * i + 2, (gy - along * y) * per_norm, mask=here)
    tl.store(g_quats + 4 * i + 3, (gz - along * z) * per_norm, mask=here)

    # the axes of the image: a = fx / z (R0 - u R2), b = fy / z (R1 - v R2)
    h0, h1, h2 = (e0 * r00 + e1 * r01 + e2 * r02, e0 * r10 + e1 * r11 + e2 * r12,
                  e0 * r20 + e1 * r21 + e2 * r22)
    i0, i1, i2 = (f0 * r00 + f1 * r01 + f2 * r02, f0 * r10 + f1 * r11 + f2 * r12,
                  f0 * r20 + f1 * r21 + f2 * r22)
    m20, m21, m22 = number(view, 6), number(view, 7), number(view, 8)
    fx, fy = number(view, FX), number(view, FY)
    d_u = -fx * per_z * (h0 * m20 + h1 * m21 + h2 * m22)
    d_v = -fy * per_z * (i0 * m20 + i1 * m21 + i2 * m22)
    held_u = (u >= number(view, LEFT)) & (u <= number(view, RIGHT))
    held_v = (v >= number(view, TOP)) & (v <= number(view, BOTTOM))
    d_u = tl.where(held_u, d_u, 0.0) + fx * d_x
    d_v = tl.where(held_v, d_v, 0.0) + fy * d_y
    d_z = depth - per_z * (g0 + g1 + g2 + u * d_u + v * d_v)  # both rows go with 1 / z
    d_u, d_v = d_u * per_z, d_v * per_z
    tl.store(g_means + 3 * i, pull_x + number(view, 0) * d_u + number(view, 3) * d_v + m20 * d_z,
             mask=here)
    tl.store(g_means + 3 * i + 1,
             pull_y + number(view, 1) * d_u + number(view, 4) * d_v + m21 * d_z, mask=here)
    tl.store(g_means + 3 * i + 2,
             pull_z + number(view, 2) * d_u + number(view, 5) * d_v + m22 * d_z, mask=here)


@triton.jit(do_not_specialize=("count",))
def harmonics_backward(directions, g_sh_dc, count, g_sh_rest, STRIDE: tl.constexpr,
                       TERMS: tl.constexpr, BLOCK: tl.constexpr):
    """Writes the gradient of sh_rest, a coefficient of the three channels a lane.

    There are `count` of them, STRIDE / 3 in a row. A lane for each Gaussian would write rows side
    by side, in 32 places of memory at once. `directions` and `g_sh_dc` are of `project_backward`.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < count
    i, term = at // (STRIDE // 3), at % (STRIDE // 3)
    used = here & (term < TERMS)
    x = tl.load(directions + 3 * i, mask=used, other=0.0)
    y = tl.load(directions + 3 * i + 1, mask=used, other=0.0)
    z = tl.load(directions + 3 * i + 2, mask=used, other=0.0)
    value = x * 0.0
    for k in tl.static_range(TERMS):
        value = tl.where(term == k, basis(k, x, y, z), value)
    value *= 1.0 / C0
    to = g_sh_rest + 3 * at.to(tl.int64)
    tl.store(to, value * tl.load(g_sh_dc + 3 * i, mask=used, other=0.0), mask=here)
    tl.store(to + 1, value * tl.load(g_sh_dc + 3 * i + 1, mask=used, other=0.0), mask=here)
    tl.store(to + 2, value * tl.load(g_sh_dc + 3 * i + 2, mask=used, other=0.0), mask=here)
