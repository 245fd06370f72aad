"""Compositing, front to back (3D Gaussian Splatting, Kerbl et al. 2023, eq. 3).

A program is one warp and composites one tile, eight pixels a lane: sums over the tile's pixels need
no barrier then. A tile is left as soon as none of its pixels is alive.
"""

from __future__ import annotations

import triton
import triton.language as tl

from recon_cli.render.triton.fragments import (
    AREA,
    FLOATS,
    SIDE,
    T_MIN,
    alpha_of,
    log2_alpha,
)

CHUNK = 16  # instances between two looks at whether a pixel is alive


@triton.jit
def composite(order, first, members, offsets, records, background, width, height, tiles_x,
              rgb, alpha, depth, final, last, slots, counting, hits, weights, peaks,
              SCORES: tl.constexpr, MASKED: tl.constexpr, CHUNK: tl.constexpr):
    """Composites one tile.

    Args:
        order: [tiles] int32, longest list first, so that no long one is left over at the end.
        first: [tiles + 1] int32, where the instances of each tile begin.
        members: [E] int32, Gaussian of each instance, by tile and depth.
        offsets: [E, 2] u and v at the tile's first pixel.
        records: [M, FLOATS].
        background: [3].
        width: of the image in pixels.
        height: of the image in pixels.
        tiles_x: tiles in a row.
        rgb: [H, W, 3] out.
        alpha: [H, W] out.
        depth: [H, W] out.
        final: [tiles, AREA] out, transmittance behind the last fragment.
        last: [tiles, AREA] int32 out, number in the tile of the last fragment, from 1.
        slots: [E] int64, where the scores of an instance go.
        counting: [H, W] uint8, pixels that count in the scores.
        hits: [E] int32 out.
        weights: [E] out, sum of alpha T.
        peaks: [E] out, greatest alpha T.
        SCORES: also take the scores.
        MASKED: of the pixels in `counting` alone.
        CHUNK: see above.
    """
    tile = tl.load(order + tl.program_id(0))
    begin, end = tl.load(first + tile), tl.load(first + tile + 1)
    pixel = tl.arange(0, AREA)
    x, y = tile % tiles_x * SIDE + pixel % SIDE, tile // tiles_x * SIDE + pixel // SIDE
    column, row = (pixel % SIDE).to(tl.float32), (pixel // SIDE).to(tl.float32)
    inside = (x < width) & (y < height)
    at = y * width + x
    # a pixel beyond the image is stopped from the start
    T = tl.where(inside, 1.0, 0.0)
    kept = T
    red, green, blue, z = T * 0.0, T * 0.0, T * 0.0, T * 0.0
    latest = pixel * 0
    counts = inside
    if MASKED:
        counts = inside & (tl.load(counting + at, mask=inside, other=0) != 0)
    e = begin
    while (e < end) & (tl.max(T) >= T_MIN):
        stop = tl.minimum(e + CHUNK, end)
        while e < stop:
            record = records + tl.load(members + e).to(tl.int64) * FLOATS
            _, _, power = log2_alpha(record, offsets + 2 * e.to(tl.int64), column, row)
            a = alpha_of(power)
            weight = T * a
            T = T * (1.0 - a)
            live = T >= T_MIN
            weight = tl.where(live, weight, 0.0)
            kept = tl.where(live, T, kept)
            red = tl.fma(weight, tl.load(record + 4), red)
            green = tl.fma(weight, tl.load(record + 5), green)
            blue = tl.fma(weight, tl.load(record + 6), blue)
            z = tl.fma(weight, tl.load(record + 7), z)
            hit = weight > 0.0
            latest = tl.where(hit, e - begin + 1, latest)
            if SCORES:
                slot = tl.load(slots + e)
                counted = tl.where(counts, weight, 0.0)
                tl.store(hits + slot, tl.sum((counted > 0.0).to(tl.int32)))
                tl.store(weights + slot, tl.sum(counted))
                tl.store(peaks + slot, tl.max(counted))
            e += 1
    tl.store(final + tile * AREA + pixel, kept)
    tl.store(last + tile * AREA + pixel, latest)
    tl.store(rgb + 3 * at, tl.fma(kept, tl.load(background), red), mask=inside)
    tl.store(rgb + 3 * at + 1, tl.fma(kept, tl.load(background + 1), green), mask=inside)
    tl.store(rgb + 3 * at + 2, tl.fma(kept, tl.load(background + 2), blue), mask=inside)
    tl.store(alpha + at, 1.0 - kept, mask=inside)
    tl.store(depth + at, z, mask=inside)


@triton.jit(do_not_specialize=("count",))
def tally(starts, hits, weights, peaks, count, total_hits, blend_sum, blend_max,
          BLOCK: tl.constexpr):
    """Sums hits and weights and takes the greatest peak over the slots of each Gaussian.

    Args:
        starts: [M + 1] int32, first slot of each Gaussian.
        hits: [E] int32.
        weights: [E].
        peaks: [E].
        count: M.
        total_hits: [M] int64 out.
        blend_sum: [M] out.
        blend_max: [M] out.
        BLOCK: Gaussians a program.
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
