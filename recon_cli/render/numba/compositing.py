"""Compositing, front to back (3D Gaussian Splatting, Kerbl et al. 2023, eq. 3).

For each pixel, over the Gaussians of its tile in order of depth:

    alpha = min(.99, o exp(-q / 2)), a fragment where alpha >= 1/255
    C += alpha T c,  T <- T (1 - alpha), before the fragment that would leave T < 1e-4.

A row of a tile is one vector. Instances are taken in batches, in the coordinates of their tile.
Rows are the outer loop of a batch, so that colour and transmittance stay in registers.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.kernel import inlined, kernel
from recon_cli.render.numba.simd import LANES
from recon_cli.render.numba.simd_functions import (
    bits, broadcast, count_bits, exp2, fetch_add, fill, floor, fma, lane_numbers, largest, load,
    lowest_bit, maximum, minimum, select, square_root, store, total)
from recon_cli.render.numba.soa import (
    BATCH, BLUE, DEPTH, EXTENT_X, EXTENT_Y, FAR, GREEN, HALF_Y, LOG2_ALPHA_MAX, LOG2_OPACITY,
    MEAN_X, MEAN_X_LOW, MEAN_Y, MEAN_Y_LOW, RECORD, RED, SLOPE_Y, TILE_HEIGHT, TILE_PIXELS,
    TILE_WIDTH, U_X, U_Y, V_Y)

# An instance of a batch: u = U_X i + U_Y r + U_0 and v = V_Y r + V_0 at column i and row r of the
# tile; the rest is the record's own.
LOCAL = 16
L_U_0, L_U_X, L_U_Y, L_V_0, L_V_Y, L_POWER, L_RED, L_GREEN, L_BLUE, L_DEPTH = range(10)
# What the range of rows is found from, one vector of instances each.
RANGE = 8
BATCH_FLOATS = LOCAL * BATCH + (RANGE + 2) * BATCH  # the last two: first row and end
_RANGES = LOCAL * BATCH
FIRST_ROW, END_ROW = _RANGES + RANGE * BATCH, _RANGES + (RANGE + 1) * BATCH
_MARGIN = np.float32(1e-3)  # pixels; more than the rounding of a pixel coordinate
_T, _FINAL, _LAST, _RED, _GREEN, _BLUE, _DEPTH = (i * TILE_PIXELS for i in range(7))
_COUNTS = 7 * TILE_PIXELS  # 1 where a pixel counts in the scores, 0 elsewhere
_ALPHA = 8 * TILE_PIXELS  # alpha of a row for each instance of a batch
# Scores of each instance of a batch, column by column: sums along each row take three times as long
_HITS, _SUMS, _PEAKS = (_ALPHA + i * BATCH * LANES for i in range(1, 4))
_BATCH = _ALPHA + 4 * BATCH * LANES
FORWARD_FLOATS = _BATCH + BATCH_FLOATS
_ONE = np.float32(1)


@inlined
def load_batch(batch, records, members, first, count, left, top):
    """Fills `batch` with `count` instances of the tile whose first pixel is (left, top)."""
    for k in range(count):
        at, to = np.int64(members[first + k]) * RECORD, k * LOCAL
        # in float64: far from the mean of a needle the two terms of u nearly cancel
        dx = left + 0.5 - records[at + MEAN_X] - np.float64(records[at + MEAN_X_LOW])
        dy = top + 0.5 - records[at + MEAN_Y] - np.float64(records[at + MEAN_Y_LOW])
        u_x, u_y, v_y = records[at + U_X], records[at + U_Y], records[at + V_Y]
        batch[to + L_U_0] = np.float32(u_x * dx + u_y * dy)
        batch[to + L_U_X], batch[to + L_U_Y], batch[to + L_V_Y] = u_x, u_y, v_y
        batch[to + L_V_0] = np.float32(v_y * dy)
        batch[to + L_POWER] = records[at + LOG2_OPACITY]
        batch[to + L_RED] = records[at + RED]
        batch[to + L_GREEN] = records[at + GREEN]
        batch[to + L_BLUE] = records[at + BLUE]
        batch[to + L_DEPTH] = records[at + DEPTH]
        ranges = _RANGES + k
        batch[ranges] = np.float32(dx)
        batch[ranges + BATCH] = np.float32(dy)
        batch[ranges + 2 * BATCH] = records[at + EXTENT_X]
        batch[ranges + 3 * BATCH] = records[at + EXTENT_Y]
        batch[ranges + 4 * BATCH] = records[at + SLOPE_Y]
        batch[ranges + 5 * BATCH] = records[at + HALF_Y]
        batch[ranges + 6 * BATCH] = u_x
        batch[ranges + 7 * BATCH] = u_y
    for k in range(0, BATCH, LANES):
        find_rows(batch, k, count)


@inlined
def find_rows(batch, k, count):
    """Finds the rows where the ellipses of instances k to k + LANES meet the tile's columns."""
    at = _RANGES + k
    dx, dy = load(batch, at), load(batch, at + BATCH)
    extent_x, extent_y = load(batch, at + 2 * BATCH), load(batch, at + 3 * BATCH)
    slope_y, half = load(batch, at + 4 * BATCH), load(batch, at + 5 * BATCH)
    slope_x = -load(batch, at + 7 * BATCH) / load(batch, at + 6 * BATCH)
    slope_x = select(half < FAR, slope_x, 0.0)  # a box without an ellipse has no slope
    low = maximum(dx, -extent_x)
    high = minimum(dx + (TILE_WIDTH - 1), extent_x)
    inside = (low <= high) & (lane_numbers() < count - k)
    per_extent = 1.0 / extent_x
    lowest = slope_x * extent_y  # offset of the ellipse's lowest point, where y is greatest
    x = minimum(maximum(lowest, low), high)
    across = x * per_extent
    bottom = slope_y * x + half * square_root(maximum(1.0 - across * across, 0.0))
    x = minimum(maximum(-lowest, low), high)
    across = x * per_extent
    above = slope_y * x - half * square_root(maximum(1.0 - across * across, 0.0))
    above, bottom = maximum(above, -extent_y), minimum(bottom, extent_y)
    first = -floor(dy - above + _MARGIN)  # the smallest row r with dy + r >= above
    end = floor(bottom - dy + _MARGIN) + 1.0
    first = maximum(first, 0.0)
    end = minimum(end, TILE_HEIGHT)
    store(batch, FIRST_ROW + k, select(inside, first, 0.0))
    store(batch, END_ROW + k, select(inside, end, 0.0))


@inlined
def log2_alpha(batch, at, column, row):
    """Returns u, v and log2 alpha along a row of pixels: the same bits in both passes."""
    u = fma(broadcast(batch, at + L_U_X), column,
            fma(broadcast(batch, at + L_U_Y), row, broadcast(batch, at + L_U_0)))
    v = fma(broadcast(batch, at + L_V_Y), row, broadcast(batch, at + L_V_0))
    return u, v, fma(-v, v, fma(-u, u, broadcast(batch, at + L_POWER)))


@inlined
def row_bits(batch, row):
    """Returns which instances of the batch meet a row, instance 0 in the lowest bit."""
    mask = np.uint64(0)
    for k in range(0, BATCH, LANES):
        meets = (load(batch, FIRST_ROW + k) <= row) & (load(batch, END_ROW + k) > row)
        mask |= bits(meets) << np.uint64(k)
    return mask


@inlined
def clear_scores(scratch):
    """Sets the scores of the instances of a batch to zero."""
    for i in range(_HITS, _BATCH, LANES):
        store(scratch, i, fill(0.0))


@inlined
def load_counts(scratch, counting, width, height, left, top):
    """Copies which pixels of a tile count in the scores."""
    for r in range(TILE_HEIGHT):
        for i in range(TILE_WIDTH):
            ignored = False
            if len(counting) > 0 and top + r < height and left + i < width:
                ignored = not counting[(top + r) * width + left + i]
            scratch[_COUNTS + r * TILE_WIDTH + i] = np.float32(0) if ignored else _ONE


@kernel
def composite(counter, tile_start, members, records, width, height, tiles_x, cutoff, t_min,
              background, rgb, alpha, depth, final, last, scores, counting, slots, hits, weights,
              peaks, evaluated, scratch):
    """Composites tile by tile.

    Args:
        counter: [1] shared; tiles already taken.
        tile_start: [tiles + 1] where the instances of each tile begin.
        members: [E] Gaussian of each instance, by tile and depth.
        records: [M * 16].
        cutoff: log2 of the least alpha of a fragment.
        t_min: transmittance before which a pixel stops.
        rgb: [H * W * 3] out; [H * W] out are alpha, and depth, the sum of alpha T z.
        final: [tiles * TILE_PIXELS] out, T at the end.
        last: [tiles * TILE_PIXELS] out, number of the last instance that contributed, from 1.
        scores: write hits, weights and peaks.
        counting: [H * W] which pixels count in the scores, or empty for all.
        slots: [E] slot of each instance.
        hits: [E] out by slot, zeros before; so are weights, the sum, and peaks, the maximum of
            alpha T.
        evaluated: [1] pairs of an instance and a pixel are added.
    """
    tiles = len(tile_start) - 1
    column = lane_numbers()
    batch = scratch[_BATCH:]
    pairs = 0
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= tiles:
            break
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        alive = np.uint64(0)
        for r in range(TILE_HEIGHT):
            at = r * TILE_WIDTH
            inside = select(column < width - left, fill(1.0), fill(0.0))
            if top + r >= height:
                inside = fill(0.0)
            else:
                alive |= np.uint64(1) << np.uint64(r)
            store(scratch, _T + at, inside)
            store(scratch, _FINAL + at, fill(1.0))
            for plane in range(2, 7):
                store(scratch, plane * TILE_PIXELS + at, fill(0.0))
        if scores:
            clear_scores(scratch)
            load_counts(scratch, counting, width, height, left, top)
        begin, end = tile_start[tile], tile_start[tile + 1]
        for first in range(begin, end, BATCH):
            load_batch(batch, records, members, first, min(BATCH, end - first), left, top)
            for r in range(TILE_HEIGHT):
                if not (alive >> np.uint64(r)) & np.uint64(1):
                    continue
                row = fill(np.float32(r))
                meets = row_bits(batch, row)
                if meets == 0:
                    continue
                pairs += count_bits(meets) * LANES
                at = r * TILE_WIDTH
                T, final_T = load(scratch, _T + at), load(scratch, _FINAL + at)
                latest, z = load(scratch, _LAST + at), load(scratch, _DEPTH + at)
                red, green = load(scratch, _RED + at), load(scratch, _GREEN + at)
                blue = load(scratch, _BLUE + at)
                # two short chains of operations overlap better than one long one
                left_over, to = meets, _ALPHA
                while left_over != 0:
                    k = lowest_bit(left_over)
                    left_over &= left_over - np.uint64(1)
                    _, _, power = log2_alpha(batch, k * LOCAL, column, row)
                    a = exp2(minimum(power, LOG2_ALPHA_MAX))
                    store(scratch, to, select(power >= cutoff, a, 0.0))
                    to += LANES
                left_over, to = meets, _ALPHA
                while left_over != 0:
                    k = lowest_bit(left_over)
                    left_over &= left_over - np.uint64(1)
                    i, a = k * LOCAL, load(scratch, to)
                    to += LANES
                    weight = T * a
                    T = T * (1.0 - a)
                    live = t_min <= T
                    weight = select(live, weight, 0.0)
                    red = fma(weight, broadcast(batch, i + L_RED), red)
                    green = fma(weight, broadcast(batch, i + L_GREEN), green)
                    blue = fma(weight, broadcast(batch, i + L_BLUE), blue)
                    z = fma(weight, broadcast(batch, i + L_DEPTH), z)
                    final_T = select(live, T, final_T)
                    hit = weight > 0.0
                    latest = select(hit, fill(np.float32(first - begin + k + 1)), latest)
                    if scores:
                        weight = weight * load(scratch, _COUNTS + at)
                        i = k * LANES
                        store(scratch, _HITS + i, load(scratch, _HITS + i)
                              + select(weight > 0.0, fill(1.0), fill(0.0)))
                        store(scratch, _SUMS + i, load(scratch, _SUMS + i) + weight)
                        store(scratch, _PEAKS + i, maximum(load(scratch, _PEAKS + i), weight))
                store(scratch, _T + at, T)
                store(scratch, _FINAL + at, final_T)
                store(scratch, _LAST + at, latest)
                store(scratch, _RED + at, red)
                store(scratch, _GREEN + at, green)
                store(scratch, _BLUE + at, blue)
                store(scratch, _DEPTH + at, z)
                if bits(t_min <= T) == 0:
                    alive &= ~(np.uint64(1) << np.uint64(r))
            if scores:
                for k in range(min(BATCH, end - first)):
                    slot = slots[first + k]
                    hits[slot] = np.int32(total(load(scratch, _HITS + k * LANES)))
                    weights[slot] = total(load(scratch, _SUMS + k * LANES))
                    peaks[slot] = largest(load(scratch, _PEAKS + k * LANES))
                clear_scores(scratch)
            if alive == 0:
                break
        for r in range(TILE_HEIGHT):
            at = r * TILE_WIDTH
            y = top + r
            store(final, tile * TILE_PIXELS + at, load(scratch, _FINAL + at))
            store(last, tile * TILE_PIXELS + at, load(scratch, _LAST + at))
            if y < height:
                for i in range(min(TILE_WIDTH, width - left)):
                    p = y * width + left + i
                    t = scratch[_FINAL + at + i]
                    rgb[3 * p] = scratch[_RED + at + i] + t * background[0]
                    rgb[3 * p + 1] = scratch[_GREEN + at + i] + t * background[1]
                    rgb[3 * p + 2] = scratch[_BLUE + at + i] + t * background[2]
                    alpha[p] = _ONE - t
                    depth[p] = scratch[_DEPTH + at + i]
    fetch_add(evaluated, 0, pairs)


@kernel
def tally(ids, slot_start, hits, weights, peaks, total_hits, blend_sum, blend_max):
    """Sums hits and weights and takes the greatest peak over the slots of each Gaussian."""
    for j in range(len(ids)):
        summed = 0.0  # float64
        for slot in range(slot_start[j], slot_start[j + 1]):
            total_hits[ids[j]] += hits[slot]
            summed += weights[slot]
            blend_max[ids[j]] = max(blend_max[ids[j]], peaks[slot])
        blend_sum[ids[j]] = np.float32(summed)
