"""Compositing, front to back (3D Gaussian Splatting, Kerbl et al. 2023, eq. 3).

For each pixel, over the Gaussians of its tile in order of depth:

    alpha = min(.99, o exp(-q / 2)), a fragment where alpha >= 1/255
    C += alpha T c,  T <- T (1 - alpha), before the fragment that would leave T < 1e-4.

A row of a tile is one vector. Rows are the outer loop of a batch, so that colour and transmittance
stay in registers while the instances that meet the row pass by.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.batches import (
    BATCH_FLOATS,
    END_ROW,
    FIRST_ROW,
    L_BLUE,
    L_DEPTH,
    L_GREEN,
    L_POWER,
    L_RED,
    L_U_0,
    L_U_X,
    L_U_Y,
    L_V_0,
    L_V_Y,
    LOCAL,
    load_batch,
)
from recon_cli.render.numba.kernel import inlined, kernel
from recon_cli.render.numba.simd import LANES
from recon_cli.render.numba.simd_functions import (
    bits,
    count_bits,
    exp2,
    fill,
    fma,
    lane_numbers,
    largest,
    lowest_bit,
    maximum,
    minimum,
    select,
    total,
)
from recon_cli.render.numba.simd_memory import fetch_add, load, spread, store
from recon_cli.render.numba.soa import BATCH, LOG2_ALPHA_MAX, TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH

_T, _FINAL, _LAST, _RED, _GREEN, _BLUE, _DEPTH = (i * TILE_PIXELS for i in range(7))
_COUNTS = 7 * TILE_PIXELS  # 1 where a pixel counts in the scores, 0 elsewhere
_ALPHA = 8 * TILE_PIXELS  # alpha of a row for each instance of a batch
# Scores of each instance of a batch, column by column: a sum along the row for each row and each
# of them would take three times as long.
_HITS, _SUMS, _PEAKS = (_ALPHA + i * BATCH * LANES for i in range(1, 4))
_BATCH = _ALPHA + 4 * BATCH * LANES
FORWARD_FLOATS = _BATCH + BATCH_FLOATS
_ONE = np.float32(1)


@inlined
def log2_alpha(batch, at, column, row):
    """Returns u, v and log2 alpha along a row of pixels: the same bits in both passes."""
    u = fma(spread(batch, at + L_U_X), column,
            fma(spread(batch, at + L_U_Y), row, spread(batch, at + L_U_0)))
    v = fma(spread(batch, at + L_V_Y), row, spread(batch, at + L_V_0))
    return u, v, fma(-v, v, fma(-u, u, spread(batch, at + L_POWER)))


@inlined
def row_bits(batch, row):
    """Returns which instances of the batch meet a row, instance 0 in the lowest bit."""
    found = np.uint64(0)
    for k in range(0, BATCH, LANES):
        meets = (load(batch, FIRST_ROW + k) <= row) & (load(batch, END_ROW + k) > row)
        found |= bits(meets) << np.uint64(k)
    return found


@inlined
def clear_scores(scratch):
    """Sets the scores of the instances of a batch to zero."""
    for i in range(_HITS, _BATCH, LANES):
        store(scratch, i, fill(0.0))


@inlined
def load_counts(scratch, counting, width, height, left, top):
    """Takes over which pixels of a tile count in the scores."""
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
        width: of the image in pixels.
        height: of the image in pixels.
        tiles_x: tiles in a row.
        cutoff: log2 of the least alpha of a fragment.
        t_min: transmittance before which a pixel stops.
        background: [3].
        rgb: [H * W * 3] out.
        alpha: [H * W] out, 1 - T at the end.
        depth: [H * W] out, sum of alpha T z.
        final: [tiles * TILE_PIXELS] out, T at the end.
        last: [tiles * TILE_PIXELS] out, number of the last instance that contributed, from 1.
        scores: count hits, and sum and compare blend weights.
        counting: [H * W] which pixels count in the scores, or empty for all.
        slots: [E] slot of each instance.
        hits: [E] out by slot, pixels that the instance contributes to; zeros before.
        weights: [E] out by slot, sum of alpha T; zeros before.
        peaks: [E] out by slot, greatest alpha T; zeros before.
        evaluated: [1] pairs of an instance and a pixel are added.
        scratch: of the thread.
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
                T, kept = load(scratch, _T + at), load(scratch, _FINAL + at)
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
                    red = fma(weight, spread(batch, i + L_RED), red)
                    green = fma(weight, spread(batch, i + L_GREEN), green)
                    blue = fma(weight, spread(batch, i + L_BLUE), blue)
                    z = fma(weight, spread(batch, i + L_DEPTH), z)
                    kept = select(live, T, kept)
                    hit = weight > 0.0
                    latest = select(hit, fill(np.float32(first - begin + k + 1)), latest)
                    if scores:
                        weight = weight * load(scratch, _COUNTS + at)
                        i = k * LANES
                        store(scratch, _HITS + i, load(scratch, _HITS + i)
                              + select(weight > 0.0, fill(1.0), fill(0.0)))
                        store(scratch, _SUMS + i, load(scratch, _SUMS + i) + weight)
                        store(scratch, _PEAKS + i,
                              maximum(load(scratch, _PEAKS + i), weight))
                store(scratch, _T + at, T)
                store(scratch, _FINAL + at, kept)
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
