"""Gauss-Newton products of one view: J v by a forward sweep, and the diagonal blocks of J^T W J.

J^T u is `ViewPass.backward`. The exponent of a fragment, log2 alpha = log2 o - u^2 - v^2, changes
with the raw parameters of its Gaussian by a polynomial of the whitened offset (u, v) of the pixel,

    d log2 alpha = e . (1, u, v, u^2, u v, v^2),

whose six coefficients are linear in the change of mean, quaternion, scales and logit. A sweep over
the fragments needs these and the change of the colour. Colours are of degree 0.
"""

from __future__ import annotations

import math

import numpy as np
from block_kernels import SIZE, TRIANGLE

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    bits,
    broadcast,
    exp2,
    fetch_add,
    fill,
    fma,
    largest,
    load,
    lowest_bit,
    minimum,
    select,
    store,
    totals,
)
from recon_cli.render.contract import DILATION
from recon_cli.render.numba.compositing import (
    BATCH_FLOATS,
    FORWARD_FLOATS,
    LOCAL,
    load_batch,
    load_instance,
    log2_alpha,
    patch_pixels,
    pixel,
)
from recon_cli.render.numba.projection import C0
from recon_cli.render.numba.soa import (
    BATCH,
    BLOCK,
    BLUE,
    GREEN,
    LOG2_ALPHA_MAX,
    LOG2_E,
    PATCHES,
    RECORD,
    RED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
)

LN2 = np.float32(math.log(2))
TANGENT = 16  # numbers of a Gaussian's tangent: six of the exponent, three of the colour
_RED, _GREEN, _BLUE = 6, 7, 8
MOMENTS = 15  # of u^i v^j up to degree 4, by degree and j
BLOCK_SLOT = 32  # numbers of an instance: the moments, three of the colour, zeros
_UNIT = math.sqrt(LOG2_E / 2)
_ROW = np.array([0, 1, 1, 2, 2, 2])  # degree of 1, u, v, u^2, u v, v^2
_POWER = np.array([0, 0, 1, 0, 1, 2])  # of v in them
# planes of a tile in scratch
_T, _DT, _D_RED, _D_GREEN, _D_BLUE = (i * TILE_PIXELS for i in range(5))
_LIMITS = 5 * TILE_PIXELS
_TANGENTS = _LIMITS + PATCHES
_BATCH = _TANGENTS + TANGENT * BATCH
TANGENT_FLOATS = _BATCH + FORWARD_FLOATS
(_B_T, _B_LAST, _B_BEHIND_RED, _B_BEHIND_GREEN, _B_BEHIND_BLUE, _B_RED, _B_GREEN, _B_BLUE,
 _B_COLUMN, _B_ROW) = (i * TILE_PIXELS for i in range(10))
_B_LIMITS = 10 * TILE_PIXELS
_B_BATCH = _B_LIMITS + PATCHES
BLOCK_FLOATS = _B_BATCH + BATCH_FLOATS
FRAME = 64


@inlined
def write_frame(view, means, quats, log_scales, logits, i, frame):
    """Writes what the tangents of Gaussian i are made of to `frame` [FRAME] float64.

    In order: 1 / z, x / z and y / z, whether each is inside its limits, the factors fx / z and
    fy / z, 1 - o; the quaternion (8 to 11) and the inverse of its length; the scaled axes (16 to
    24); the rows of J W (25 to 30); V = J W R S (31 to 36); a, b, c and the determinant.
    """
    R = view.R
    x, y, z = (np.float64(means[3 * i]), np.float64(means[3 * i + 1]),
               np.float64(means[3 * i + 2]))
    to_x = R[0] * x + R[1] * y + R[2] * z + view.t[0]
    to_y = R[3] * x + R[4] * y + R[5] * z + view.t[1]
    to_z = R[6] * x + R[7] * y + R[8] * z + view.t[2]
    per_z = 1 / to_z
    u, v = to_x * per_z, to_y * per_z
    held_u, held_v = min(max(u, view.tan_left), view.tan_right), min(
        max(v, view.tan_top), view.tan_bottom)
    frame[0], frame[1], frame[2] = per_z, u, v
    frame[3] = 1.0 if held_u == u else 0.0
    frame[4] = 1.0 if held_v == v else 0.0
    frame[5], frame[6] = view.fx * per_z, view.fy * per_z
    frame[7] = 1 / (1 + math.exp(np.float64(logits[i])))
    w, a, b, c = (np.float64(quats[4 * i]), np.float64(quats[4 * i + 1]),
                  np.float64(quats[4 * i + 2]), np.float64(quats[4 * i + 3]))
    length = math.sqrt(w * w + a * a + b * b + c * c)
    per_length = 1 / length if length > 0 else 0.0
    w, a, b, c = (w * per_length, a * per_length, b * per_length, c * per_length)
    if length == 0:
        w = 1.0
    frame[8], frame[9], frame[10], frame[11], frame[12] = w, a, b, c, per_length
    frame[13], frame[14], frame[15] = (
        math.exp(log_scales[3 * i]), math.exp(log_scales[3 * i + 1]),
        math.exp(log_scales[3 * i + 2]))
    frame[16] = 1 - 2 * (b * b + c * c)
    frame[17] = 2 * (a * b - w * c)
    frame[18] = 2 * (a * c + w * b)
    frame[19] = 2 * (a * b + w * c)
    frame[20] = 1 - 2 * (a * a + c * c)
    frame[21] = 2 * (b * c - w * a)
    frame[22] = 2 * (a * c - w * b)
    frame[23] = 2 * (b * c + w * a)
    frame[24] = 1 - 2 * (a * a + b * b)
    for k in range(3):
        for row in range(3):
            frame[16 + 3 * row + k] *= frame[13 + k]
        frame[25 + k] = frame[5] * (R[k] - held_u * R[6 + k])
        frame[28 + k] = frame[6] * (R[3 + k] - held_v * R[6 + k])
    for k in range(3):
        frame[31 + k] = (frame[25] * frame[16 + k] + frame[26] * frame[19 + k]
                         + frame[27] * frame[22 + k])
        frame[34 + k] = (frame[28] * frame[16 + k] + frame[29] * frame[19 + k]
                         + frame[30] * frame[22 + k])
    a0 = frame[31] * frame[31] + frame[32] * frame[32] + frame[33] * frame[33] + DILATION
    b0 = frame[31] * frame[34] + frame[32] * frame[35] + frame[33] * frame[36]
    c0 = frame[34] * frame[34] + frame[35] * frame[35] + frame[36] * frame[36] + DILATION
    frame[37], frame[38], frame[39], frame[40] = a0, b0, c0, a0 * c0 - b0 * b0


@inlined
def write_exponent(view, frame, change, work, out):
    """Writes the six coefficients by which the exponent changes with a `change` [11] to `out`."""
    R = view.R
    d_x = R[0] * change[0] + R[1] * change[1] + R[2] * change[2]
    d_y = R[3] * change[0] + R[4] * change[1] + R[5] * change[2]
    d_z = R[6] * change[0] + R[7] * change[1] + R[8] * change[2]
    per_z = frame[0]
    d_u, d_v = (d_x - frame[1] * d_z) * per_z, (d_y - frame[2] * d_z) * per_z
    mean_x, mean_y = view.fx * d_u, view.fy * d_v
    w, a, b, c = frame[8], frame[9], frame[10], frame[11]
    along = w * change[3] + a * change[4] + b * change[5] + c * change[6]
    d_w, d_a = (change[3] - along * w) * frame[12], (change[4] - along * a) * frame[12]
    d_b, d_c = (change[5] - along * b) * frame[12], (change[6] - along * c) * frame[12]
    work[0] = -4 * (b * d_b + c * d_c)
    work[1] = 2 * (d_a * b + a * d_b - d_w * c - w * d_c)
    work[2] = 2 * (d_a * c + a * d_c + d_w * b + w * d_b)
    work[3] = 2 * (d_a * b + a * d_b + d_w * c + w * d_c)
    work[4] = -4 * (a * d_a + c * d_c)
    work[5] = 2 * (d_b * c + b * d_c - d_w * a - w * d_a)
    work[6] = 2 * (d_a * c + a * d_c - d_w * b - w * d_b)
    work[7] = 2 * (d_b * c + b * d_c + d_w * a + w * d_a)
    work[8] = -4 * (a * d_a + b * d_b)
    d_aa, d_bb, d_ab = 0.0, 0.0, 0.0
    shrink = -d_z * per_z
    for k in range(3):
        first, second = 0.0, 0.0
        for row in range(3):
            axis = frame[16 + 3 * row + k]
            turned = work[3 * row + k] * frame[13 + k] + axis * change[7 + k]
            by_u = shrink * frame[25 + row] - frame[5] * d_u * frame[3] * R[6 + row]
            by_v = shrink * frame[28 + row] - frame[6] * d_v * frame[4] * R[6 + row]
            first += by_u * axis + frame[25 + row] * turned
            second += by_v * axis + frame[28 + row] * turned
        d_aa += 2 * frame[31 + k] * first
        d_ab += frame[31 + k] * second + frame[34 + k] * first
        d_bb += 2 * frame[34 + k] * second
    aa, ab, bb, det = frame[37], frame[38], frame[39], frame[40]
    d_det = d_aa * bb + aa * d_bb - 2 * ab * d_ab
    u_x, v_y = _UNIT * math.sqrt(bb / det), _UNIT / math.sqrt(bb)
    u_y = -ab / bb * u_x
    out[0] = LOG2_E * frame[7] * change[10]
    out[1] = 2 * (u_x * mean_x + u_y * mean_y)
    out[2] = 2 * v_y * mean_y
    out[3] = d_det / det - d_bb / bb
    out[4] = 2 * (d_ab - ab * d_bb / bb) / bb * u_x / v_y
    out[5] = d_bb / bb


@kernel
def project_tangent(counter, ids, means, quats, log_scales, logits, records, view, d_means,
                    d_quats, d_log_scales, d_logits, d_sh_dc, tangents):
    """Writes the tangent of every Gaussian in `ids` for a change of the raw parameters."""
    frame, change = np.empty(FRAME), np.empty(SIZE)
    work, out = np.empty(9), np.empty(6)
    while True:
        block = fetch_add(counter, 0, 1)
        if block * BLOCK >= len(ids):
            break
        for j in range(block * BLOCK, min((block + 1) * BLOCK, len(ids))):
            i, at = np.int64(ids[j]), j * TANGENT
            write_frame(view, means, quats, log_scales, logits, i, frame)
            for k in range(3):
                change[k], change[7 + k] = d_means[3 * i + k], d_log_scales[3 * i + k]
            for k in range(4):
                change[3 + k] = d_quats[4 * i + k]
            change[10] = d_logits[i]
            write_exponent(view, frame, change, work, out)
            for k in range(6):
                tangents[at + k] = out[k]
            for k in range(3):
                seen = records[j * RECORD + RED + k] > 0
                tangents[at + _RED + k] = C0 * d_sh_dc[3 * i + k] if seen else np.float32(0)


@kernel
def composite_tangent(counter, tile_start, members, records, tangents, width, height, tiles_x,
                      cutoff, background, last, rgb, scratch):
    """Writes the change of a view's colours, [H * W * 3], to first order.

    Patches whose `last` is zero are skipped, and get zeros.
    """
    batch = scratch[_BATCH:]
    patches = np.zeros(PATCHES, np.uint64)
    tiles = len(tile_start) - 1
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= tiles:
            break
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        deepest = np.float32(0)
        for patch in range(PATCHES):
            at = patch * LANES
            limit = largest(load(last, tile * TILE_PIXELS + at))
            scratch[_LIMITS + patch] = limit
            deepest = max(deepest, limit)
            store(scratch, _T + at, fill(1.0))
            for plane in range(1, 5):
                store(scratch, plane * TILE_PIXELS + at, fill(0.0))
        begin = tile_start[tile]
        end = begin + np.int64(deepest)
        for first in range(begin, end, BATCH):
            count = min(BATCH, end - first)
            load_batch(batch, patches, records, members, first, count, left, top)
            for k in range(count):
                for i in range(0, TANGENT, LANES):
                    store(scratch, _TANGENTS + k * TANGENT + i,
                          load(tangents, np.int64(members[first + k]) * TANGENT + i))
            for patch in range(PATCHES):
                meets = patches[patch]
                if meets == 0 or scratch[_LIMITS + patch] <= np.float32(first - begin):
                    continue
                column, row = patch_pixels(patch)
                at = patch * LANES
                latest = load(last, tile * TILE_PIXELS + at)
                T, d_T = load(scratch, _T + at), load(scratch, _DT + at)
                red, green = load(scratch, _D_RED + at), load(scratch, _D_GREEN + at)
                blue = load(scratch, _D_BLUE + at)
                while meets != 0:
                    k = lowest_bit(meets)
                    meets &= meets - np.uint64(1)
                    i, t = k * LOCAL, _TANGENTS + k * TANGENT
                    u, v, power = log2_alpha(batch, i, column, row)
                    a = exp2(minimum(power, LOG2_ALPHA_MAX))
                    part = (power >= cutoff) & (latest >= np.float32(first + k - begin + 1))
                    a = select(part, a, 0.0)
                    slope = fma(u, fma(u, broadcast(scratch, t + 3), fma(
                        v, broadcast(scratch, t + 4), broadcast(scratch, t + 1))), fma(
                            v, fma(v, broadcast(scratch, t + 5), broadcast(scratch, t + 2)),
                            broadcast(scratch, t)))
                    d_a = select(power <= LOG2_ALPHA_MAX, a * (LN2 * slope), 0.0)
                    weight = T * a
                    d_weight = fma(d_T, a, T * d_a)
                    red = fma(d_weight, broadcast(batch, i + RED),
                              fma(weight, broadcast(scratch, t + _RED), red))
                    green = fma(d_weight, broadcast(batch, i + GREEN),
                                fma(weight, broadcast(scratch, t + _GREEN), green))
                    blue = fma(d_weight, broadcast(batch, i + BLUE),
                               fma(weight, broadcast(scratch, t + _BLUE), blue))
                    d_T, T = d_T - d_weight, T - weight
                store(scratch, _T + at, T)
                store(scratch, _DT + at, d_T)
                store(scratch, _D_RED + at, red)
                store(scratch, _D_GREEN + at, green)
                store(scratch, _D_BLUE + at, blue)
        for r in range(min(TILE_HEIGHT, height - top)):
            for i in range(min(TILE_WIDTH, width - left)):
                p, at = (top + r) * width + left + i, pixel(i, r)
                behind = scratch[_DT + at]
                rgb[3 * p] = scratch[_D_RED + at] + behind * background[0]
                rgb[3 * p + 1] = scratch[_D_GREEN + at] + behind * background[1]
                rgb[3 * p + 2] = scratch[_D_BLUE + at] + behind * background[2]


@kernel
def composite_blocks(counter, tile_start, members, slots, records, width, height, tiles_x, cutoff,
                     background, final, last, met, weights, sums, scratch):
    """Sums over the pixels of each instance what its diagonal block of J^T W J is made of.

    `weights` [H * W * 3] is the diagonal of W. With s the change of a pixel's colour by the
    exponent, written are the moments of sum w s^2 and, of each colour, sum w (alpha T)^2:
    `sums` [E * 32] by slot.
    """
    tiles = len(tile_start) - 1
    batch = scratch[_B_BATCH:]
    zero = fill(0.0)
    for patch in range(PATCHES):
        column, row = patch_pixels(patch)
        store(scratch, _B_COLUMN + patch * LANES, column)
        store(scratch, _B_ROW + patch * LANES, row)
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= tiles:
            break
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        begin = tile_start[tile]
        deepest = np.float32(0)
        for patch in range(PATCHES):
            at = patch * LANES
            latest = load(last, tile * TILE_PIXELS + at)
            limit = largest(latest)
            scratch[_B_LIMITS + patch] = limit
            deepest = max(deepest, limit)
            store(scratch, _B_T + at, load(final, tile * TILE_PIXELS + at))
            store(scratch, _B_LAST + at, latest)
            store(scratch, _B_BEHIND_RED + at, broadcast(background, 0))
            store(scratch, _B_BEHIND_GREEN + at, broadcast(background, 1))
            store(scratch, _B_BEHIND_BLUE + at, broadcast(background, 2))
        for r in range(TILE_HEIGHT):
            for i in range(TILE_WIDTH):
                at, inside = pixel(i, r), top + r < height and left + i < width
                p = (top + r) * width + left + i
                scratch[_B_RED + at] = weights[3 * p] if inside else np.float32(0)
                scratch[_B_GREEN + at] = weights[3 * p + 1] if inside else np.float32(0)
                scratch[_B_BLUE + at] = weights[3 * p + 2] if inside else np.float32(0)
        end = begin + np.int64(deepest)
        for e in range(end, tile_start[tile + 1]):
            for i in range(0, BLOCK_SLOT, LANES):
                store(sums, np.int64(slots[e]) * BLOCK_SLOT + i, zero)
        while end > begin:
            first = max(begin, end - BATCH)
            for k in range(end - first):
                load_instance(batch, records, k, members[first + k], left, top)
            for k in range(end - first - 1, -1, -1):
                number = np.float32(first + k - begin + 1)
                needed = np.uint64(0)
                for patch in range(0, PATCHES, LANES):
                    needed |= bits(load(scratch, _B_LIMITS + patch) >= number) << np.uint64(patch)
                needed &= np.uint64(met[first + k])
                m_00, m_10, m_01, m_20, m_11, m_02 = zero, zero, zero, zero, zero, zero
                m_30, m_21, m_12, m_03 = zero, zero, zero, zero
                m_40, m_31, m_22, m_13, m_04 = zero, zero, zero, zero, zero
                c_red, c_green, c_blue = zero, zero, zero
                i = k * LOCAL
                while needed != 0:
                    at = lowest_bit(needed) * LANES
                    needed &= needed - np.uint64(1)
                    u, v, power = log2_alpha(
                        batch, i, load(scratch, _B_COLUMN + at), load(scratch, _B_ROW + at))
                    a = exp2(minimum(power, LOG2_ALPHA_MAX))
                    part = (power >= cutoff) & (load(scratch, _B_LAST + at) >= number)
                    a = select(part, a, 0.0)
                    T = load(scratch, _B_T + at) / (1.0 - a)
                    store(scratch, _B_T + at, T)
                    square = a * T * a * T
                    behind = load(scratch, _B_BEHIND_RED + at)
                    away = broadcast(batch, i + RED) - behind
                    store(scratch, _B_BEHIND_RED + at, fma(a, away, behind))
                    w = load(scratch, _B_RED + at)
                    c_red = fma(square, w, c_red)
                    q = w * away * away
                    behind = load(scratch, _B_BEHIND_GREEN + at)
                    away = broadcast(batch, i + GREEN) - behind
                    store(scratch, _B_BEHIND_GREEN + at, fma(a, away, behind))
                    w = load(scratch, _B_GREEN + at)
                    c_green = fma(square, w, c_green)
                    q = fma(w * away, away, q)
                    behind = load(scratch, _B_BEHIND_BLUE + at)
                    away = broadcast(batch, i + BLUE) - behind
                    store(scratch, _B_BEHIND_BLUE + at, fma(a, away, behind))
                    w = load(scratch, _B_BLUE + at)
                    c_blue = fma(square, w, c_blue)
                    q = fma(w * away, away, q) * square
                    q = select(power <= LOG2_ALPHA_MAX, q, 0.0)
                    uu, uv, vv = u * u, u * v, v * v
                    q_uu, q_uv, q_vv = q * uu, q * uv, q * vv
                    m_00, m_10, m_01 = m_00 + q, fma(q, u, m_10), fma(q, v, m_01)
                    m_20, m_11, m_02 = m_20 + q_uu, m_11 + q_uv, m_02 + q_vv
                    m_30, m_21 = fma(q_uu, u, m_30), fma(q_uu, v, m_21)
                    m_12, m_03 = fma(q_vv, u, m_12), fma(q_vv, v, m_03)
                    m_40, m_31, m_22 = fma(q_uu, uu, m_40), fma(q_uu, uv, m_31), fma(
                        q_uu, vv, m_22)
                    m_13, m_04 = fma(q_uv, vv, m_13), fma(q_vv, vv, m_04)
                to = np.int64(slots[first + k]) * BLOCK_SLOT
                if LANES == 16:
                    store(sums, to, totals((
                        m_00, m_10, m_01, m_20, m_11, m_02, m_30, m_21, m_12, m_03, m_40, m_31,
                        m_22, m_13, m_04, c_red)))
                    store(sums, to + 16, totals((
                        c_green, c_blue, zero, zero, zero, zero, zero, zero, zero, zero, zero,
                        zero, zero, zero, zero, zero)))
                else:
                    store(sums, to, totals((m_00, m_10, m_01, m_20, m_11, m_02, m_30, m_21)))
                    store(sums, to + 8, totals((m_12, m_03, m_40, m_31, m_22, m_13, m_04, c_red)))
                    store(sums, to + 16, totals((
                        c_green, c_blue, zero, zero, zero, zero, zero, zero)))
            end = first


@kernel
def project_blocks(counter, ids, slot_start, sums, means, quats, log_scales, logits, records, view,
                   factor, blocks, colors):
    """Adds `factor` times the blocks of a view to `blocks` [N * 66] and `colors` [N * 3]."""
    frame, change = np.empty(FRAME), np.zeros(SIZE)
    work, out = np.empty(9), np.empty(6)
    total, map_, half = np.empty(MOMENTS + 3), np.empty((SIZE, 6)), np.empty(6)
    square = np.float64(LN2) * np.float64(LN2) * factor
    while True:
        block = fetch_add(counter, 0, 1)
        if block * BLOCK >= len(ids):
            break
        for j in range(block * BLOCK, min((block + 1) * BLOCK, len(ids))):
            if slot_start[j + 1] == slot_start[j]:
                continue
            i = np.int64(ids[j])
            total[:] = 0
            for slot in range(slot_start[j], slot_start[j + 1]):
                for k in range(MOMENTS + 3):
                    total[k] += sums[slot * BLOCK_SLOT + k]
            write_frame(view, means, quats, log_scales, logits, i, frame)
            for number in range(SIZE):
                change[number] = 1
                write_exponent(view, frame, change, work, out)
                change[number] = 0
                map_[number] = out
            at = i * TRIANGLE
            for row in range(SIZE):
                for k in range(6):
                    half[k] = 0
                    for m in range(6):
                        degree = _ROW[k] + _ROW[m]
                        half[k] += map_[row, m] * total[
                            degree * (degree + 1) // 2 + _POWER[k] + _POWER[m]]
                for column in range(row + 1):
                    entry = 0.0
                    for k in range(6):
                        entry += half[k] * map_[column, k]
                    blocks[at] += square * entry
                    at += 1
            for k in range(3):
                if records[j * RECORD + RED + k] > 0:
                    colors[3 * i + k] += factor * C0 * C0 * total[MOMENTS + k]
