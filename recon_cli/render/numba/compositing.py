"""Compositing, front to back (3D Gaussian Splatting, Kerbl et al. 2023, eq. 3).

For each pixel, over the Gaussians of its tile in order of depth:

    alpha = min(.99, o exp(-q / 2)), a fragment where alpha >= 1/255
    C += alpha T c,  T <- T (1 - alpha), before the fragment that would leave T < 1e-4.

A patch of a tile is one vector. Instances are taken in batches, in the coordinates of their tile.
Patches are the outer loop of a batch, so that colour and transmittance stay in registers.
"""

from __future__ import annotations

import numpy as np

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    bits, broadcast, exp2, fetch_add, fill, floor, fma, lane_numbers, largest, load,
    lowest_bit, maximum, minimum, select, square_root, store, total)
from recon_cli.render.numba.soa import (
    BATCH, BLUE, DEPTH, EXTENT_X, EXTENT_Y, FAR, GREEN, HALF_Y, LOG2_ALPHA_MAX, LOG2_OPACITY,
    MEAN_X, MEAN_X_LOW, MEAN_Y, MEAN_Y_LOW, PATCH_HEIGHT, PATCH_WIDTH, PATCHES, PATCHES_X,
    PATCHES_Y, RECORD, RED, SLOPE_Y, TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, U_X, U_Y, V_Y)

# An instance of a batch: its record, where u = U_X i + U_Y r + U_0 and v = V_Y r + V_0 at column i
# and row r of the tile take the places of what float32 drops of the mean.
LOCAL = RECORD
U_0, V_0 = MEAN_X_LOW, MEAN_Y_LOW
# What the patches that an ellipse meets are found from, one plane of instances each.
_PLANES = 9
_DX, _DY, _EXTENT_X, _EXTENT_Y, _SLOPE_Y, _HALF_Y, _U_X, _U_Y, _V_Y = (
    LOCAL * BATCH + i * BATCH for i in range(_PLANES))
BATCH_FLOATS = LOCAL * BATCH
# Which patches each instance meets, bits as integers: a plane for as many rows of patches as
# float32 holds exactly
_MET = (LOCAL + _PLANES) * BATCH
_MET_ROWS = 24 // PATCHES_X
_MET_PLANES = -(-PATCHES_Y // _MET_ROWS)
_MARGIN = np.float32(1e-3)  # pixels; more than the rounding of a pixel coordinate
_T, _FINAL, _LAST, _RED, _GREEN, _BLUE, _DEPTH = (i * TILE_PIXELS for i in range(7))
_COUNTS = 7 * TILE_PIXELS  # 1 where a pixel counts in the scores, 0 elsewhere
# Scores of each instance of a batch, lane by lane: sums over each patch take three times as long
_HITS, _SUMS, _PEAKS = (8 * TILE_PIXELS + i * BATCH * LANES for i in range(3))
_BATCH = 8 * TILE_PIXELS + 3 * BATCH * LANES
FORWARD_FLOATS = _BATCH + _MET + _MET_PLANES * BATCH
_ONE = np.float32(1)


@inlined
def load_instance(batch, records, k, member, left, top):
    """Copies a Gaussian into place k of `batch`; returns the offset of the tile's first pixel.

    That is (left, top), and the offset is from the Gaussian's mean.
    """
    at, to = np.int64(member) * RECORD, k * LOCAL
    for i in range(0, RECORD, LANES):
        store(batch, to + i, load(records, at + i))
    # in float64: far from the mean of a needle the two terms of u nearly cancel
    dx = left + 0.5 - records[at + MEAN_X] - np.float64(records[at + MEAN_X_LOW])
    dy = top + 0.5 - records[at + MEAN_Y] - np.float64(records[at + MEAN_Y_LOW])
    batch[to + U_0] = np.float32(records[at + U_X] * dx + records[at + U_Y] * dy)
    batch[to + V_0] = np.float32(records[at + V_Y] * dy)
    return dx, dy


@inlined
def load_batch(batch, patches, records, members, first, count, left, top):
    """Fills `batch` with `count` instances of the tile whose first pixel is (left, top).

    Written are also `patches` [PATCHES] uint64, which instances meet each patch, instance 0 in the
    lowest bit.
    """
    for k in range(count):
        dx, dy = load_instance(batch, records, k, members[first + k], left, top)
        to = k * LOCAL
        batch[_DX + k], batch[_DY + k] = np.float32(dx), np.float32(dy)
        batch[_EXTENT_X + k], batch[_EXTENT_Y + k] = batch[to + EXTENT_X], batch[to + EXTENT_Y]
        batch[_SLOPE_Y + k], batch[_HALF_Y + k] = batch[to + SLOPE_Y], batch[to + HALF_Y]
        batch[_U_X + k], batch[_U_Y + k] = batch[to + U_X], batch[to + U_Y]
        batch[_V_Y + k] = batch[to + V_Y]
    for patch in range(PATCHES):
        patches[patch] = np.uint64(0)
    for k in range(0, count, LANES):
        find_patches(batch, patches, k, count)


@inlined
def find_patches(batch, patches, k, count):
    """Adds which of the instances k to k + LANES meet each patch: exact up to rounding.

    Over the rows of pixels of a row of patches an ellipse covers one interval of x.
    """
    dx, dy = load(batch, _DX + k), load(batch, _DY + k)
    extent_x, extent_y = load(batch, _EXTENT_X + k), load(batch, _EXTENT_Y + k)
    per_u = 1.0 / load(batch, _U_X + k)
    slope, half = -load(batch, _U_Y + k) * per_u, extent_y * load(batch, _V_Y + k) * per_u
    square = load(batch, _HALF_Y + k) >= FAR  # so large that only its box cuts
    slope, half = select(square, 0.0, slope), select(square, fill(FAR), half)
    rightmost = load(batch, _SLOPE_Y + k) * extent_x  # y offset of the rightmost point
    per_extent = 1.0 / extent_y
    valid = lane_numbers() < count - k
    met = fill(0.0)
    for row in range(PATCHES_Y):
        if row % _MET_ROWS == 0:
            met = fill(0.0)
        low = dy + np.float32(row * PATCH_HEIGHT)
        high = minimum(low + np.float32(PATCH_HEIGHT - 1), extent_y)
        low = maximum(low, -extent_y)
        y = minimum(maximum(rightmost, low), high)
        along = y * per_extent
        right = slope * y + half * square_root(maximum(1.0 - along * along, 0.0))
        y = minimum(maximum(-rightmost, low), high)
        along = y * per_extent
        left = slope * y - half * square_root(maximum(1.0 - along * along, 0.0))
        # columns of pixels of the tile; the first one in is the next integer
        left = -floor(dx - maximum(left, -extent_x) + _MARGIN)
        right = floor(minimum(right, extent_x) - dx + _MARGIN)
        inside = (low <= high) & (left <= right) & valid
        for column in range(PATCHES_X):
            meets = (inside & (left <= np.float32((column + 1) * PATCH_WIDTH - 1))
                     & (right >= np.float32(column * PATCH_WIDTH)))
            patch = row * PATCHES_X + column
            patches[patch] |= bits(meets) << np.uint64(k)
            met = met + select(meets, fill(np.float32(1 << patch % (_MET_ROWS * PATCHES_X))), 0.0)
        if (row + 1) % _MET_ROWS == 0 or row == PATCHES_Y - 1:
            store(batch, _MET + row // _MET_ROWS * BATCH + k, met)


@inlined
def row_terms(batch, at, row):
    """Returns what u, v and log2 alpha have of a row of patches alone."""
    v = fma(broadcast(batch, at + V_Y), row, broadcast(batch, at + V_0))
    return (fma(broadcast(batch, at + U_Y), row, broadcast(batch, at + U_0)), v,
            fma(-v, v, broadcast(batch, at + LOG2_OPACITY)))


@inlined
def log2_alpha(batch, at, column, row):
    """Returns u, v and log2 alpha at pixels of a tile: the same bits in both passes."""
    u_row, v, power_row = row_terms(batch, at, row)
    u = fma(broadcast(batch, at + U_X), column, u_row)
    return u, v, fma(-u, u, power_row)


@inlined
def patch_pixels(patch):
    """Returns the columns and rows of a patch's pixels in their tile."""
    column = np.float32(patch % PATCHES_X * PATCH_WIDTH)
    row = np.float32(patch // PATCHES_X * PATCH_HEIGHT)
    down = floor(lane_numbers() * np.float32(1 / PATCH_WIDTH))
    return column + (lane_numbers() - PATCH_WIDTH * down), row + down


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
            scratch[_COUNTS + pixel(i, r)] = np.float32(0) if ignored else _ONE


@inlined
def pixel(column, row):
    """Returns where a pixel of a tile lies in its planes."""
    patch = row // PATCH_HEIGHT * PATCHES_X + column // PATCH_WIDTH
    return patch * LANES + row % PATCH_HEIGHT * PATCH_WIDTH + column % PATCH_WIDTH


@kernel
def composite(counter, tile_start, members, records, width, height, tiles_x, cutoff, t_min,
              background, rgb, alpha, depth, final, last, met, scores, counting, slots, hits,
              weights, peaks, scratch):
    """Composites tile by tile.

    Args:
        counter: [1] shared; tiles already taken.
        tile_start: [tiles + 1] where the instances of each tile begin.
        members: [E] Gaussian of each instance, by tile and depth.
        records: [M * 16].
        cutoff: log2 of the least alpha of a fragment.
        t_min: transmittance before which a pixel stops.
        rgb: [H * W * 3] out; [H * W] out are alpha, and depth, the sum of alpha T z, empty where it
            is not wanted.
        final: [tiles * TILE_PIXELS] out, T at the end, patch by patch.
        last: [tiles * TILE_PIXELS] out, number of the last instance that contributed, from 1.
        met: [E] uint32 out, which patches each instance meets, as far as any were looked at.
        scores: write hits, weights and peaks.
        counting: [H * W] which pixels count in the scores, or empty for all.
        slots: [E] slot of each instance.
        hits: [E] out by slot, zeros before; so are weights, the sum, and peaks, the maximum of
            alpha T.
    """
    tiles = len(tile_start) - 1
    has_depth = len(depth) > 0
    batch = scratch[_BATCH:]
    patches = np.zeros(PATCHES, np.uint64)
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= tiles:
            break
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        alive = np.uint64(0)
        for patch in range(PATCHES):
            at = patch * LANES
            column, row = patch_pixels(patch)
            inside = (column < width - left) & (row < height - top)
            if bits(inside) != 0:
                alive |= np.uint64(1) << np.uint64(patch)
            store(scratch, _T + at, select(inside, fill(1.0), 0.0))
            store(scratch, _FINAL + at, fill(1.0))
            for plane in range(2, 7):
                store(scratch, plane * TILE_PIXELS + at, fill(0.0))
        if scores:
            clear_scores(scratch)
            load_counts(scratch, counting, width, height, left, top)
        begin, end = tile_start[tile], tile_start[tile + 1]
        for first in range(begin, end, BATCH):
            count = min(BATCH, end - first)
            load_batch(batch, patches, records, members, first, count, left, top)
            for k in range(count):
                mask = np.uint64(0)
                for plane in range(_MET_PLANES):
                    mask |= np.uint64(np.int64(batch[_MET + plane * BATCH + k])) << np.uint64(
                        plane * _MET_ROWS * PATCHES_X)
                met[first + k] = mask
            remaining = alive
            while remaining != 0:
                patch = lowest_bit(remaining)
                remaining &= remaining - np.uint64(1)
                meets = patches[patch]
                if meets == 0:
                    continue
                column, row = patch_pixels(patch)
                at = patch * LANES
                T, final_T = load(scratch, _T + at), load(scratch, _FINAL + at)
                latest, z = load(scratch, _LAST + at), load(scratch, _DEPTH + at)
                red, green = load(scratch, _RED + at), load(scratch, _GREEN + at)
                blue = load(scratch, _BLUE + at)
                while meets != 0:
                    k = lowest_bit(meets)
                    meets &= meets - np.uint64(1)
                    i = k * LOCAL
                    _, _, power = log2_alpha(batch, i, column, row)
                    a = exp2(minimum(power, LOG2_ALPHA_MAX))
                    a = select(power >= cutoff, a, 0.0)
                    weight = T * a
                    T = T * (1.0 - a)
                    live = t_min <= T
                    weight = select(live, weight, 0.0)
                    red = fma(weight, broadcast(batch, i + RED), red)
                    green = fma(weight, broadcast(batch, i + GREEN), green)
                    blue = fma(weight, broadcast(batch, i + BLUE), blue)
                    if has_depth:
                        z = fma(weight, broadcast(batch, i + DEPTH), z)
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
                    alive &= ~(np.uint64(1) << np.uint64(patch))
            if scores:
                for k in range(count):
                    slot = slots[first + k]
                    hits[slot] = np.int32(total(load(scratch, _HITS + k * LANES)))
                    weights[slot] = total(load(scratch, _SUMS + k * LANES))
                    peaks[slot] = largest(load(scratch, _PEAKS + k * LANES))
                clear_scores(scratch)
            if alive == 0:
                break
        for at in range(0, TILE_PIXELS, LANES):
            store(final, tile * TILE_PIXELS + at, load(scratch, _FINAL + at))
            store(last, tile * TILE_PIXELS + at, load(scratch, _LAST + at))
        for r in range(min(TILE_HEIGHT, height - top)):
            for i in range(min(TILE_WIDTH, width - left)):
                p, at = (top + r) * width + left + i, pixel(i, r)
                t = scratch[_FINAL + at]
                rgb[3 * p] = scratch[_RED + at] + t * background[0]
                rgb[3 * p + 1] = scratch[_GREEN + at] + t * background[1]
                rgb[3 * p + 2] = scratch[_BLUE + at] + t * background[2]
                alpha[p] = _ONE - t
                if has_depth:
                    depth[p] = scratch[_DEPTH + at]


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
