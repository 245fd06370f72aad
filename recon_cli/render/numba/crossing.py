"""Which Gaussian of each pixel brings the transmittance down to a level, such as the median at 1/2.

The walk is that of `compositing`, but over the transmittance alone, and a pixel ends where it has
its answer. Training never runs this kernel.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.compositing import LOCAL, load_batch, log2_alpha, patch_pixels, pixel
from recon_cli.kernels.kernel import kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    bits, exp2, fetch_add, fill, load, lowest_bit, minimum, select, store)
from recon_cli.render.numba.soa import (
    BATCH, LOG2_ALPHA_MAX, PATCHES, TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH)

_T, _FOUND, _BATCH = 0, TILE_PIXELS, 2 * TILE_PIXELS  # in scratch


@kernel
def find_crossing(counter, tile_start, members, records, ids, width, height, tiles_x, cutoff,
                  level, crossing, scratch):
    """Finds the Gaussian after which T <= level, tile by tile.

    Args:
        counter: [1] shared; tiles already taken.
        tile_start: [tiles + 1] where the instances of each tile begin.
        members: [E] projected Gaussian of each instance, by tile and depth.
        records: [M * 16].
        ids: [M] row of each projected Gaussian in the scene.
        cutoff: log2 of the least alpha of a fragment.
        level: transmittance.
        crossing: [H * W] int32 out, row in the scene; -1 where T stays above the level.
    """
    tiles = len(tile_start) - 1
    batch = scratch[_BATCH:]
    patches = np.zeros(PATCHES, np.uint64)
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= tiles:
            break
        left, top = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        alive = np.uint64(0)
        for patch in range(PATCHES):
            column, row = patch_pixels(patch)
            inside = (column < width - left) & (row < height - top)
            if bits(inside) != 0:
                alive |= np.uint64(1) << np.uint64(patch)
            store(scratch, _T + patch * LANES, select(inside, fill(1.0), 0.0))
            store(scratch, _FOUND + patch * LANES, fill(0.0))
        begin, end = tile_start[tile], tile_start[tile + 1]
        for first in range(begin, end, BATCH):
            count = min(BATCH, end - first)
            load_batch(batch, patches, records, members, first, count, left, top)
            remaining = alive
            while remaining != 0:
                patch = lowest_bit(remaining)
                remaining &= remaining - np.uint64(1)
                meets = patches[patch]
                if meets == 0:
                    continue
                column, row = patch_pixels(patch)
                at = patch * LANES
                T, found = load(scratch, _T + at), load(scratch, _FOUND + at)
                while meets != 0:
                    k = lowest_bit(meets)
                    meets &= meets - np.uint64(1)
                    _, _, power = log2_alpha(batch, k * LOCAL, column, row)
                    a = exp2(minimum(power, LOG2_ALPHA_MAX))
                    a = select(power >= cutoff, a, 0.0)
                    after = T * (1.0 - a)
                    crosses = (level < T) & (after <= level)
                    found = select(crosses, fill(np.float32(first - begin + k + 1)), found)
                    T = after
                store(scratch, _T + at, T)
                store(scratch, _FOUND + at, found)
                if bits(level < T) == 0:
                    alive &= ~(np.uint64(1) << np.uint64(patch))
            if alive == 0:
                break
        for r in range(min(TILE_HEIGHT, height - top)):
            for i in range(min(TILE_WIDTH, width - left)):
                number = np.int64(scratch[_FOUND + pixel(i, r)])
                row_of = np.int32(-1)
                if number > 0:
                    row_of = np.int32(ids[members[begin + number - 1]])
                crossing[(top + r) * width + left + i] = row_of
