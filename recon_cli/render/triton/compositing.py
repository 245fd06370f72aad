"""Gradients of compositing, back to front.

With g the gradient of the loss at a pixel, c the colour of a Gaussian and R the loss's slope along
what is composited behind it, the remainder of Kerbl et al. 2023 in scalar form:

    R <- g . background at the last fragment,  R <- R + alpha (g . c - R) after each,
    dL/dc = alpha T g,  s = alpha dL/dalpha = alpha T (g . c - R),  T <- T / (1 - alpha).

s is zero where alpha was clamped. Every instance has a slot for its sums over the tile; slots of a
Gaussian lie side by side and are added in order: no atomics, and the same bits every time.

A long list would keep one warp busy when all others are done. So the backward pass goes by buckets
of BUCKET instances, all at once: the forward pass keeps the transmittance T and the colours C at
the end of each bucket, and with the image I the remainder there is R = g . (I - C) / T (Mallick et
al. 2024, "Taming 3DGS", keep them likewise). Both passes load an instance before they need it.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

PIXELS = TILE * TILE
RECORD = 8  # floats a Gaussian: U_X, U_Y, V_Y, log2 o, red, green, blue, depth
SUMS = 16  # floats an instance, see `composite_backward`
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
def log2_alpha(u_x, u_y, v_y, log2_opacity, u_0, v_0, column, row):
    """Returns u, v and log2 alpha at pixels [256]: the same bits in both passes."""
    u = tl.fma(u_x, column, tl.fma(u_y, row, u_0))
    v = tl.fma(v_y, row, v_0)
    power = tl.fma(-v, v, tl.fma(-u, u, log2_opacity))
    return u, v, power


@triton.jit
def alpha_of(power):
    """Returns alpha of log2 alpha; 0 below ALPHA_MIN."""
    return tl.where(power >= LOG2_ALPHA_MIN, tl.exp2(tl.minimum(power, LOG2_ALPHA_MAX)), 0.0)


CHUNK = 16  # instances between two looks at whether a pixel is alive
BUCKET = 64  # instances; CHUNK divides it
STATE = 5  # floats a pixel kept at the end of a bucket: T, red, green, blue, depth
KEPT = tl.constexpr(STATE)


@triton.jit
def load_record(records, member, here):
    """Returns the eight numbers of a Gaussian."""
    record = records + member.to(tl.int64) * FLOATS
    return (tl.load(record, mask=here, other=0.0), tl.load(record + 1, mask=here, other=0.0),
            tl.load(record + 2, mask=here, other=0.0), tl.load(record + 3, mask=here, other=0.0),
            tl.load(record + 4, mask=here, other=0.0), tl.load(record + 5, mask=here, other=0.0),
            tl.load(record + 6, mask=here, other=0.0), tl.load(record + 7, mask=here, other=0.0))


@triton.jit
def load_offset(offsets, e, here):
    """Returns u and v of instance e at its tile's first pixel."""
    offset = offsets + 2 * e.to(tl.int64)
    return tl.load(offset, mask=here, other=0.0), tl.load(offset + 1, mask=here, other=0.0)


@triton.jit(do_not_specialize=("width", "height", "tiles_x"))
def composite(
    order, first, members, offsets, records, background, width, height, tiles_x, rgb, alpha, depth,
    final, last, states, bucket_tiles, slots, counting, hits, weights, peaks, KEEP: tl.constexpr,
    PLAIN: tl.constexpr, SCORES: tl.constexpr, MASKED: tl.constexpr, CHUNK: tl.constexpr,
    BUCKET: tl.constexpr,
):
    """Composites one tile.

    Bucket k of tile t holds its instances from k BUCKET to (k + 1) BUCKET, in the numbers of all
    instances, and has the number k + t.

    Args:
        order: [tiles] int32, longest list first, so that no long one is left over at the end.
        first: [tiles + 1] int32, where the instances of each tile begin.
        members: [E] int32, Gaussian of each instance, by tile and depth.
        offsets: [E, 2] u and v at the tile's first pixel.
        records: [M, FLOATS].
        rgb: [H, W, 3] out; alpha and depth are [H, W], not written with PLAIN.
        final: [tiles, AREA] out with KEEP, transmittance behind the last fragment.
        last: [tiles, AREA] int32 out with KEEP, number in the tile of the last fragment, from 1.
        states: [buckets, KEPT, AREA], with PLAIN one less, out with KEEP, at the end of each bucket
            behind which the tile continues.
        bucket_tiles: [buckets] int32 out with KEEP, the tile of each.
        slots: [E] int64, where the scores of an instance go.
        counting: [H, W] uint8, pixels that count in the scores, with MASKED.
        hits: [E] int32 out with SCORES; so are weights, the sum, and peaks, the maximum of alpha T.
    """
    tile = tl.load(order + tl.program_id(0))
    begin, end = tl.load(first + tile), tl.load(first + tile + 1)
    pixel = tl.arange(0, AREA)
    x, y = tile % tiles_x * SIDE + pixel % SIDE, tile // tiles_x * SIDE + pixel // SIDE
    column, row = (pixel % SIDE).to(tl.float32), (pixel // SIDE).to(tl.float32)
    inside = (x < width) & (y < height)
    at = y * width + x
    if KEEP:
        bucket = begin // BUCKET + tile
        while bucket <= end // BUCKET + tile:
            tl.store(bucket_tiles + bucket, tile)
            bucket += 1
    # a pixel beyond the image is stopped from the start
    T = tl.where(inside, 1.0, 0.0)
    final_T = T
    red, green, blue, z = T * 0.0, T * 0.0, T * 0.0, T * 0.0
    latest = pixel * 0
    counts = inside
    if MASKED:
        counts = inside & (tl.load(counting + at, mask=inside, other=0) != 0)
    e = begin
    # the record of an instance is loaded one turn ahead, its number two
    member = tl.load(members + e, mask=e < end, other=0)
    n_ux, n_uy, n_vy, n_log2, n_red, n_green, n_blue, n_z = load_record(records, member, e < end)
    n_u, n_v = load_offset(offsets, e, e < end)
    member = tl.load(members + e + 1, mask=e + 1 < end, other=0)
    while (e < end) & (tl.max(T) >= T_MIN):
        stop = tl.minimum(e // CHUNK * CHUNK + CHUNK, end)
        while e < stop:
            u_x, u_y, v_y, log2_o, u_0, v_0 = n_ux, n_uy, n_vy, n_log2, n_u, n_v
            c_red, c_green, c_blue, c_z = n_red, n_green, n_blue, n_z
            more = e + 1 < end
            n_ux, n_uy, n_vy, n_log2, n_red, n_green, n_blue, n_z = load_record(
                records, member, more)
            n_u, n_v = load_offset(offsets, e + 1, more)
            member = tl.load(members + e + 2, mask=e + 2 < end, other=0)
            _, _, power = log2_alpha(u_x, u_y, v_y, log2_o, u_0, v_0, column, row)
            a = alpha_of(power)
            weight = T * a
            T = T * (1.0 - a)
            live = T >= T_MIN
            weight = tl.where(live, weight, 0.0)
            final_T = tl.where(live, T, final_T)
            red = tl.fma(weight, c_red, red)
            green = tl.fma(weight, c_green, green)
            blue = tl.fma(weight, c_blue, blue)
            if PLAIN == 0:
                z = tl.fma(weight, c_z, z)
            hit = weight > 0.0
            latest = tl.where(hit, e - begin + 1, latest)
            if SCORES:
                slot = tl.load(slots + e)
                counted = tl.where(counts, weight, 0.0)
                tl.store(hits + slot, tl.sum((counted > 0.0).to(tl.int32)))
                tl.store(weights + slot, tl.sum(counted))
                tl.store(peaks + slot, tl.max(counted))
            e += 1
        if KEEP:  # noqa: SIM102  # known when it is compiled, the next one is not
            if (e % BUCKET == 0) & (e < end):
                ended = (e // BUCKET - 1 + tile).to(tl.int64)
                state = states + ended * ((KEPT - PLAIN) * AREA) + pixel
                tl.store(state, final_T)
                tl.store(state + AREA, red)
                tl.store(state + 2 * AREA, green)
                tl.store(state + 3 * AREA, blue)
                if PLAIN == 0:
                    tl.store(state + 4 * AREA, z)
    if KEEP:
        tl.store(final + tile * AREA + pixel, final_T)
        tl.store(last + tile * AREA + pixel, latest)
    tl.store(rgb + 3 * at, tl.fma(final_T, tl.load(background), red), mask=inside)
    tl.store(rgb + 3 * at + 1, tl.fma(final_T, tl.load(background + 1), green), mask=inside)
    tl.store(rgb + 3 * at + 2, tl.fma(final_T, tl.load(background + 2), blue), mask=inside)
    if PLAIN == 0:
        tl.store(alpha + at, 1.0 - final_T, mask=inside)
        tl.store(depth + at, z, mask=inside)


@triton.jit(do_not_specialize=("count",))
def tally(starts, hits, weights, peaks, count, total_hits, blend_sum, blend_max,
          BLOCK: tl.constexpr):
    """Sums hits and weights and takes the greatest peak over the slots of each Gaussian.

    `hits`, `weights` and `peaks` are those of `composite`, `starts` [count + 1] int32 the first
    slot of each Gaussian; written are [count] int64 hits and float32 sums and maxima.
    """
    j = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = j < count
    slot, end = tl.load(starts + j, mask=here, other=0), tl.load(starts + j + 1, mask=here, other=0)
    number, total, peak = slot.to(tl.int64) * 0, slot.to(tl.float64) * 0, slot.to(tl.float32) * 0
    while tl.max(end - slot) > 0:
        more = slot < end
        number += tl.load(hits + slot, mask=more, other=0).to(tl.int64)
        total += tl.load(weights + slot, mask=more, other=0.0).to(tl.float64)
        peak = tl.maximum(peak, tl.load(peaks + slot, mask=more, other=0.0))
        slot += 1
    tl.store(total_hits + j, number, mask=here)
    tl.store(blend_sum + j, total.to(tl.float32), mask=here)
    tl.store(blend_max + j, peak, mask=here)


@triton.jit(do_not_specialize=("width", "height", "tiles_x", "tiles"))
def composite_backward(
    first, members, offsets, records, background, width, height, tiles_x, tiles, rgb, depth, final,
    last, states, bucket_tiles, grad_rgb, grad_alpha, grad_depth, slots, counting, sums,
    PLANES: tl.constexpr, PLAIN: tl.constexpr, DETAILS: tl.constexpr, SCORES: tl.constexpr,
    MASKED: tl.constexpr, BUCKET: tl.constexpr,
):
    """Sums the gradients of every instance of a bucket over the pixels of its tile.

    The arguments are those of `composite`, `states` with PLANES, and `grad_*`, dL/d(rgb, alpha,
    depth). With PLAIN the loss depends on colours alone, and the latter two are not read. Written
    are `sums` [E, SLOT] by slot: dL/d(red, green, blue, depth) and the sums of s times 1, u, v, uu,
    uv, vv; with DETAILS that of s^2, and the fragments; with SCORES what leaving the instance out
    would change, over the pixels in `counting`. All are zero where no pixel reached the instance.
    """
    number = tl.program_id(0)
    if number >= tl.load(first + tiles) // BUCKET + tiles:
        return
    tile = tl.load(bucket_tiles + number)
    begin, end = tl.load(first + tile), tl.load(first + tile + 1)
    low = tl.maximum(begin, (number - tile) * BUCKET)
    high = tl.minimum(end, (number - tile + 1) * BUCKET)
    if low >= high:
        return
    pixel = tl.arange(0, AREA)
    latest = tl.load(last + tile * AREA + pixel)
    e = tl.minimum(high, begin + tl.max(latest))
    if e < high:  # what no pixel reached
        rest = tl.maximum(e, low) + tl.arange(0, BUCKET)
        slot = tl.load(slots + rest, mask=rest < high, other=0)
        to = sums + slot.to(tl.int64)[:, None] * SLOT + tl.arange(0, SLOT)[None, :]
        tl.store(to, tl.zeros([BUCKET, SLOT], tl.float32), mask=(rest < high)[:, None])
    if e <= low:
        return
    x, y = tile % tiles_x * SIDE + pixel % SIDE, tile // tiles_x * SIDE + pixel // SIDE
    column, row = (pixel % SIDE).to(tl.float32), (pixel // SIDE).to(tl.float32)
    inside = (x < width) & (y < height)
    at = y * width + x
    g_red = tl.load(grad_rgb + 3 * at, mask=inside, other=0.0)
    g_green = tl.load(grad_rgb + 3 * at + 1, mask=inside, other=0.0)
    g_blue = tl.load(grad_rgb + 3 * at + 2, mask=inside, other=0.0)
    T = tl.load(final + tile * AREA + pixel)
    # behind its last fragment a pixel shows the background
    goes_on = latest > high - begin
    behind_red, behind_green = T * 0.0 + tl.load(background), T * 0.0 + tl.load(background + 1)
    behind_blue, behind_z = T * 0.0 + tl.load(background + 2), T * 0.0
    absence = T * 0.0 + 1.0  # coverage is 1 - T at the end: a colour of -1 behind everything
    if tl.max(goes_on.to(tl.int32)) > 0:
        state = states + number.to(tl.int64) * (PLANES * AREA) + pixel
        T_end = tl.load(state, mask=goes_on, other=1.0)
        per_T = 1.0 / T_end
        behind_red = tl.where(goes_on, per_T * (
            tl.load(rgb + 3 * at, mask=goes_on, other=0.0)
            - tl.load(state + AREA, mask=goes_on, other=0.0)), behind_red)
        behind_green = tl.where(goes_on, per_T * (
            tl.load(rgb + 3 * at + 1, mask=goes_on, other=0.0)
            - tl.load(state + 2 * AREA, mask=goes_on, other=0.0)), behind_green)
        behind_blue = tl.where(goes_on, per_T * (
            tl.load(rgb + 3 * at + 2, mask=goes_on, other=0.0)
            - tl.load(state + 3 * AREA, mask=goes_on, other=0.0)), behind_blue)
        if PLAIN == 0:
            behind_z = tl.where(goes_on, per_T * (
                tl.load(depth + at, mask=goes_on, other=0.0)
                - tl.load(state + 4 * AREA, mask=goes_on, other=0.0)), behind_z)
            absence = tl.where(goes_on, per_T * T, absence)
        T = tl.where(goes_on, T_end, T)
    R = g_red * behind_red + g_green * behind_green + g_blue * behind_blue
    g_depth = T * 0.0
    if PLAIN == 0:
        g_depth = tl.load(grad_depth + at, mask=inside, other=0.0)
        R += g_depth * behind_z - tl.load(grad_alpha + at, mask=inside, other=0.0) * absence
    counts = inside
    if MASKED:
        counts = inside & (tl.load(counting + at, mask=inside, other=0) != 0)
    # the record of an instance is loaded one turn ahead, its number two
    member = tl.load(members + e - 1)
    n_ux, n_uy, n_vy, n_log2, n_red, n_green, n_blue, n_z = load_record(records, member, e > low)
    n_u, n_v = load_offset(offsets, e - 1, e > low)
    n_slot = tl.load(slots + e - 1)
    member = tl.load(members + e - 2, mask=e - 1 > low, other=0)
    while e > low:
        e -= 1
        u_x, u_y, v_y, log2_o, u_0, v_0 = n_ux, n_uy, n_vy, n_log2, n_u, n_v
        red, green, blue, z, slot = n_red, n_green, n_blue, n_z, n_slot
        more = e > low
        n_ux, n_uy, n_vy, n_log2, n_red, n_green, n_blue, n_z = load_record(records, member, more)
        n_u, n_v = load_offset(offsets, e - 1, more)
        n_slot = tl.load(slots + e - 1, mask=more, other=0)
        member = tl.load(members + e - 2, mask=e - 1 > low, other=0)
        u, v, power = log2_alpha(u_x, u_y, v_y, log2_o, u_0, v_0, column, row)
        part = (power >= LOG2_ALPHA_MIN) & (latest > e - begin)
        a = tl.where(part, alpha_of(power), 0.0)
        T = T / (1.0 - a)
        weight = a * T
        shade = g_blue * blue
        if PLAIN == 0:
            shade = tl.fma(g_blue, blue, g_depth * z)
        shade = tl.fma(g_red, red, tl.fma(g_green, green, shade))
        slope = shade - R
        R = tl.fma(a, slope, R)
        s = tl.where(power <= LOG2_ALPHA_MAX, weight * slope, 0.0)
        su, sv = s * u, s * v
        to = sums + slot.to(tl.int64) * SLOT
        tl.store(to, tl.sum(weight * g_red))
        tl.store(to + 1, tl.sum(weight * g_green))
        tl.store(to + 2, tl.sum(weight * g_blue))
        if PLAIN == 0:
            tl.store(to + 3, tl.sum(weight * g_depth))
        tl.store(to + 4, tl.sum(s))
        tl.store(to + 5, tl.sum(su))
        tl.store(to + 6, tl.sum(sv))
        tl.store(to + 7, tl.sum(su * u))
        tl.store(to + 8, tl.sum(su * v))
        tl.store(to + 9, tl.sum(sv * v))
        if DETAILS:
            tl.store(to + 10, tl.sum(s * s))
            tl.store(to + 11, tl.sum(part.to(tl.float32)))
        if SCORES:
            away_red, away_green, away_blue = (
                red - behind_red, green - behind_green, blue - behind_blue)
            behind_red = tl.fma(a, away_red, behind_red)
            behind_green = tl.fma(a, away_green, behind_green)
            behind_blue = tl.fma(a, away_blue, behind_blue)
            error = away_red * away_red + away_green * away_green + away_blue * away_blue
            tl.store(to + 12, tl.sum(tl.where(counts, weight * weight * error, 0.0)))
