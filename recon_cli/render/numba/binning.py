"""Which ellipse meets which tile, and the list of every tile in order of depth.

An instance is one Gaussian in one tile. The test is exact: along a row of tiles the ellipse alpha =
1/255 covers one interval of x, found in closed form. Gaussians are sorted once by depth, then
counted into the tiles in that order, so that each tile's list is in order of depth, ties by index.
"""

from __future__ import annotations

import math

import numpy as np

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd_functions import fetch_add
from recon_cli.render.numba.soa import (
    BLOCK, EXTENT_X, EXTENT_Y, MEAN_X, MEAN_Y, RECORD, SLOPE_Y, TILE_HEIGHT, TILE_WIDTH, U_X,
    U_Y, V_Y)

_MARGIN = np.float32(1e-3)  # pixels
_U = np.uint64  # an index that is never negative needs no test for counting from the end
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0), np.float32(1)
_W, _H = np.float32(TILE_WIDTH), np.float32(TILE_HEIGHT)
_DIGIT = 11  # bits that a pass of the radix sort orders by
_PASSES = 4
_DIGITS = 1 << _DIGIT
_DIGIT_MASK = np.uint64(_DIGITS - 1)
_DROPPED = np.uint64(20)  # low bits of the mantissa; 32 of 52 stay


@kernel
def row_starts(rows, starts):
    """Writes where the spans of each Gaussian begin; the last entry is how many there are."""
    total = 0
    for j in range(len(starts) - 1):
        starts[j] = total
        total += rows[2 * j + 1]
    starts[len(starts) - 1] = total


@inlined
def order_by_depth(keys, rows, order, spare):
    """Writes the Gaussians that have rows of tiles in order of depth; returns how many.

    Ties are ordered by index. Radix sort, four passes of 11 bits. `keys` are the bits of positive
    float64 depths, which are ordered as the numbers are. float32 depths would tie where exact ones
    do not, and draw overlapping Gaussians in the wrong order.
    """
    n = 0
    for j in range(len(keys)):
        if rows[2 * j + 1] > 0:
            order[n] = j
            n += 1
    histogram = np.zeros((_PASSES, _DIGITS), np.int64)
    for i in range(n):
        key = keys[order[i]] >> _DROPPED
        for digit in range(_PASSES):
            histogram[digit, (key >> np.uint64(_DIGIT * digit)) & _DIGIT_MASK] += 1
    for digit in range(_PASSES):
        total = 0
        for b in range(_DIGITS):
            count = histogram[digit, b]
            histogram[digit, b] = total
            total += count
        for i in range(n):
            j = order[i]
            b = (keys[j] >> (_DROPPED + np.uint64(_DIGIT * digit))) & _DIGIT_MASK
            spare[histogram[digit, b]] = j
            histogram[digit, b] += 1
        order, spare = spare, order
    return n  # after an even number of passes the result lies in `order`


@kernel
def find_spans(counter, records, rows, starts, tiles_x, spans, tiles, keys, order, spare, visible):
    """Writes for each row of tiles of each Gaussian the first tile and the end, and sorts by depth.

    `rows` [M * 2] are first row and number of rows, `starts` [M + 1] where the spans of each begin.
    Written are `spans` [S * 2] and `tiles` [M], the number of tiles of each Gaussian. Meanwhile one
    thread sorts: see `order_by_depth`, whose result is `visible` [1].
    """
    n = len(tiles)
    blocks = (n + BLOCK - 1) // BLOCK
    while True:
        block = fetch_add(counter, 0, 1)
        if block == 0:
            visible[0] = order_by_depth(keys, rows, order, spare)
            continue
        block -= 1
        if block >= blocks:
            break
        for j in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            at, count = j * RECORD, 0
            mean_x, mean_y = records[at + MEAN_X], records[at + MEAN_Y]
            extent_x, extent_y = records[at + EXTENT_X], records[at + EXTENT_Y]
            per_u = _ONE / records[at + U_X]
            slope, half = -records[at + U_Y] * per_u, extent_y * records[at + V_Y] * per_u
            per_extent = _ONE / extent_y
            rightmost = records[at + SLOPE_Y] * extent_x  # y offset of the rightmost point
            for k in range(rows[2 * j + 1]):
                top = np.float32((rows[2 * j] + k) * TILE_HEIGHT) + _HALF - mean_y
                low, high = max(top, -extent_y), min(top + (_H - _ONE), extent_y)
                first, end = 0, 0
                if low <= high:
                    y = min(max(rightmost, low), high)
                    along = y * per_extent
                    right = slope * y + half * math.sqrt(max(_ONE - along * along, _ZERO))
                    right = min(right, extent_x)
                    y = min(max(-rightmost, low), high)
                    along = y * per_extent
                    left = slope * y - half * math.sqrt(max(_ONE - along * along, _ZERO))
                    left = max(left, -extent_x)
                    # pixel i lies at i + 1/2; the first one in is ceil(x - 1/2)
                    left = max(mean_x + left - _HALF - _MARGIN, _ZERO)
                    right = min(mean_x + right - _HALF + _MARGIN, _W * np.float32(tiles_x) - _ONE)
                    if left <= right:  # numbers that are not negative: the cast rounds down
                        whole = np.int64(left)
                        low_pixel = whole + (left > np.float32(whole))
                        high_pixel = np.int64(right)
                        if low_pixel <= high_pixel:
                            first = low_pixel // TILE_WIDTH
                            end = high_pixel // TILE_WIDTH + 1
                spans[2 * (starts[j] + k)] = first
                spans[2 * (starts[j] + k) + 1] = end
                count += end - first
            tiles[j] = count


@kernel
def slot_starts(tiles, starts):
    """Writes where the slots of each Gaussian begin; the last entry is the number of instances."""
    total = 0
    for j in range(len(tiles)):
        starts[j] = total
        total += tiles[j]
    starts[len(tiles)] = total


@kernel
def count_tiles(counter, cuts, order, rows, span_starts, spans, tiles_x, counts):
    """Counts the instances of each tile in each part of the order; `cuts` divides it."""
    parts = len(cuts) - 1
    while True:
        part = fetch_add(counter, 0, 1)
        if part >= parts:
            break
        own = counts[part]
        for i in range(cuts[part], cuts[part + 1]):
            j = _U(order[i])
            top, span = rows[_U(2) * j], _U(2) * _U(span_starts[j])
            for k in range(rows[_U(2) * j + _U(1)]):
                base = (top + k) * tiles_x
                for x in range(spans[span], spans[span + _U(1)]):
                    own[_U(base + x)] += 1
                span += _U(2)


@kernel
def tile_starts(counts, starts):
    """Turns counts [parts, tiles] into the places where each part of each tile begins."""
    total = 0
    for tile in range(counts.shape[1]):
        starts[tile] = total
        for part in range(counts.shape[0]):
            count = counts[part, tile]
            counts[part, tile] = total
            total += count
    starts[counts.shape[1]] = total


@kernel
def fill_tiles(counter, cuts, order, rows, span_starts, spans, tiles_x, slot_start, places,
               members, slots):
    """Writes the Gaussian and the slot of every instance to its place."""
    parts = len(cuts) - 1
    while True:
        part = fetch_add(counter, 0, 1)
        if part >= parts:
            break
        own = places[part]
        for i in range(cuts[part], cuts[part + 1]):
            j = _U(order[i])
            slot, top, span = slot_start[j], rows[_U(2) * j], _U(2) * _U(span_starts[j])
            for k in range(rows[_U(2) * j + _U(1)]):
                base = (top + k) * tiles_x
                for x in range(spans[span], spans[span + _U(1)]):
                    place = own[_U(base + x)]
                    own[_U(base + x)] = place + 1
                    members[_U(place)] = order[i]
                    slots[_U(place)] = slot
                    slot += 1
                span += _U(2)
