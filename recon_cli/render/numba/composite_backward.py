"""Gradients of compositing, back to front.

With g the gradient of the loss at a pixel, c the colour of a Gaussian and R the loss's slope along
what is composited behind it, the remainder of Kerbl et al. 2023 in scalar form:

    R <- g . background at the last fragment,  R <- R + alpha (g . c - R) after each,
    dL/dc = alpha T g,  s = alpha dL/dalpha = alpha T (g . c - R),  T <- T / (1 - alpha).

s is zero where alpha was clamped. Gradients by mean and covariance are moments of s in the whitened
coordinates (u, v), which are of order one even for needles.

An instance is the outer loop: its sums go to a slot of its own at the end: no atomics and the same
bits every time. v depends on the row of a pixel alone, so that the moments of a row of patches are
made of three sums; more than nine sums at once do not stay in the sixteen registers of AVX2.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.compositing import (
    BATCH_FLOATS, LOCAL, load_instance, log2_alpha, patch_pixels, pixel, row_terms)
from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    bits, broadcast, count_bits, exp2, fetch_add, fill, fma, lane_numbers, largest, load,
    lowest_bit, minimum, select, store, totals)
from recon_cli.render.numba.soa import (
    BATCH, BLUE, DEPTH, GREEN, LOG2_ALPHA_MAX, PATCHES, PATCHES_X, RED, SLOT, TILE_HEIGHT,
    TILE_PIXELS, TILE_WIDTH, U_X)

_T, _R, _LAST, _G_RED, _G_GREEN, _G_BLUE, _G_DEPTH = (i * TILE_PIXELS for i in range(7))
_BEHIND_RED, _BEHIND_GREEN, _BEHIND_BLUE = (i * TILE_PIXELS for i in range(7, 10))
_COUNTS = 10 * TILE_PIXELS  # 1 where a pixel counts in the scores, 0 elsewhere
_COLUMN, _ROW = 11 * TILE_PIXELS, 12 * TILE_PIXELS  # of each pixel in the tile
_LIMITS = 13 * TILE_PIXELS  # number of the last instance that each patch needs
_BATCH = _LIMITS + PATCHES
BACKWARD_FLOATS = _BATCH + BATCH_FLOATS


@kernel
def composite_backward(counter, tile_start, members, slots, records, width, height, tiles_x,
                       cutoff, background, final, last, met, grad_rgb, grad_alpha, grad_depth,
                       scores, counting, sums, scratch):
    """Sums the gradients of every instance over the pixels of its tile.

    The arguments are those of `compositing.composite`, and `grad_*`, dL/d(rgb, alpha, depth), the
    latter two empty for zeros. Written are `sums` [E * 16] by slot, see `soa`: with `scores` also
    what leaving one out would change, over `counting`.
    """
    has_alpha, has_depth = len(grad_alpha) > 0, len(grad_depth) > 0
    tiles = len(tile_start) - 1
    batch = scratch[_BATCH:]
    zero = fill(0.0)
    for patch in range(PATCHES):
        column, row = patch_pixels(patch)
        store(scratch, _COLUMN + patch * LANES, column)
        store(scratch, _ROW + patch * LANES, row)
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
            scratch[_LIMITS + patch] = largest(latest)
            deepest = max(deepest, scratch[_LIMITS + patch])
            store(scratch, _T + at, load(final, tile * TILE_PIXELS + at))
            store(scratch, _LAST + at, latest)
            if scores:
                store(scratch, _BEHIND_RED + at, broadcast(background, 0))
                store(scratch, _BEHIND_GREEN + at, broadcast(background, 1))
                store(scratch, _BEHIND_BLUE + at, broadcast(background, 2))
        rows, columns = min(TILE_HEIGHT, height - top), min(TILE_WIDTH, width - left)
        if rows * columns < TILE_PIXELS:  # nothing comes from beyond the image
            for plane in (_R, _G_RED, _G_GREEN, _G_BLUE, _G_DEPTH, _COUNTS):
                for at in range(plane, plane + TILE_PIXELS, LANES):
                    store(scratch, at, zero)
        for r in range(rows):
            for i in range(columns):
                p, at = (top + r) * width + left + i, pixel(i, r)
                red, green, blue = grad_rgb[3 * p], grad_rgb[3 * p + 1], grad_rgb[3 * p + 2]
                scratch[_G_RED + at], scratch[_G_GREEN + at] = red, green
                scratch[_G_BLUE + at] = blue
                behind = red * background[0] + green * background[1] + blue * background[2]
                if has_alpha:  # coverage is 1 - T at the end: a colour of -1 behind all
                    behind -= grad_alpha[p]
                scratch[_R + at] = behind
                if scores:
                    scratch[_COUNTS + at] = np.float32(len(counting) == 0 or counting[p])
                if has_depth:
                    scratch[_G_DEPTH + at] = grad_depth[p]
        end = begin + np.int64(deepest)
        for e in range(end, tile_start[tile + 1]):
            for i in range(0, SLOT, LANES):
                store(sums, np.int64(slots[e]) * SLOT + i, zero)
        while end > begin:
            first = max(begin, end - BATCH)
            for k in range(end - first):
                load_instance(batch, records, k, members[first + k], left, top)
            for k in range(end - first - 1, -1, -1):
                number = np.float32(first + k - begin + 1)
                needed = np.uint64(0)
                for patch in range(0, PATCHES, LANES):
                    needed |= bits(load(scratch, _LIMITS + patch) >= number) << np.uint64(patch)
                needed &= np.uint64(met[first + k])
                i = k * LOCAL
                g_red, g_green, g_blue, g_depth = zero, zero, zero, zero
                s_0, s_u, s_v, s_uu, s_uv, s_vv = zero, zero, zero, zero, zero, zero
                squared, hits, loo = zero, np.int64(0), zero
                if scores:
                    loo = leave_out(scratch, batch, i, needed, number, cutoff)
                u_x, depth = broadcast(batch, i + U_X), broadcast(batch, i + DEPTH)
                own_red, own_green = broadcast(batch, i + RED), broadcast(batch, i + GREEN)
                own_blue = broadcast(batch, i + BLUE)
                while needed != 0:
                    patch = lowest_bit(needed) & ~(PATCHES_X - 1)  # the first of its row
                    in_row = needed >> np.uint64(patch) & np.uint64((1 << PATCHES_X) - 1)
                    needed ^= in_row << np.uint64(patch)
                    base = patch * LANES
                    u_row, v, power_row = row_terms(batch, i, load(scratch, _ROW + base))
                    r_0, r_u, r_uu = zero, zero, zero
                    while in_row != 0:
                        at = lowest_bit(in_row) * LANES
                        in_row &= in_row - np.uint64(1)
                        u = fma(u_x, load(scratch, _COLUMN + at), u_row)
                        power = fma(-u, u, power_row)
                        at += base
                        a = exp2(minimum(power, LOG2_ALPHA_MAX))
                        part = (power >= cutoff) & (load(scratch, _LAST + at) >= number)
                        a = select(part, a, 0.0)
                        T = load(scratch, _T + at) / (1.0 - a)
                        store(scratch, _T + at, T)
                        weight = a * T
                        red, green = load(scratch, _G_RED + at), load(scratch, _G_GREEN + at)
                        blue = load(scratch, _G_BLUE + at)
                        shade = fma(red, own_red, fma(green, own_green, blue * own_blue))
                        if has_depth:
                            z = load(scratch, _G_DEPTH + at)
                            shade = fma(z, depth, shade)
                            g_depth = fma(weight, z, g_depth)
                        R = load(scratch, _R + at)
                        slope = shade - R
                        store(scratch, _R + at, fma(a, slope, R))
                        g_red, g_green = fma(weight, red, g_red), fma(weight, green, g_green)
                        g_blue = fma(weight, blue, g_blue)
                        s = select(power <= LOG2_ALPHA_MAX, weight * slope, 0.0)
                        su = s * u
                        r_0, r_u, r_uu = r_0 + s, r_u + su, fma(su, u, r_uu)
                        squared = fma(s, s, squared)
                        hits += count_bits(bits(part))
                    sv = r_0 * v
                    s_0, s_u, s_v = s_0 + r_0, s_u + r_u, s_v + sv
                    s_uu, s_uv, s_vv = s_uu + r_uu, fma(r_u, v, s_uv), fma(sv, v, s_vv)
                counted = select(lane_numbers() < 1.0, fill(np.float32(hits)), 0.0)
                to = np.int64(slots[first + k]) * SLOT
                if LANES == 16:
                    store(sums, to, totals((
                        g_red, g_green, g_blue, g_depth, s_0, s_u, s_v, s_uu, s_uv, s_vv,
                        squared, counted, loo, zero, zero, zero)))
                else:
                    store(sums, to, totals((g_red, g_green, g_blue, g_depth, s_0, s_u, s_v, s_uu)))
                    store(sums, to + 8, totals((
                        s_uv, s_vv, squared, counted, loo, zero, zero, zero)))
            end = first


@inlined
def leave_out(scratch, batch, i, needed, number, cutoff):
    """Returns the squared error of leaving an instance out, and puts it before what is behind."""
    loo = fill(0.0)
    while needed != 0:
        at = lowest_bit(needed) * LANES
        needed &= needed - np.uint64(1)
        _, _, power = log2_alpha(
            batch, i, load(scratch, _COLUMN + at), load(scratch, _ROW + at))
        a = exp2(minimum(power, LOG2_ALPHA_MAX))
        a = select((power >= cutoff) & (load(scratch, _LAST + at) >= number), a, 0.0)
        weight = a * (load(scratch, _T + at) / (1.0 - a))
        error = fill(0.0)
        for channel in range(3):
            plane = _BEHIND_RED + channel * TILE_PIXELS + at
            behind = load(scratch, plane)
            away = broadcast(batch, i + RED + channel) - behind
            store(scratch, plane, fma(a, away, behind))
            error = fma(away, away, error)
        loo = fma(weight * weight * load(scratch, _COUNTS + at), error, loo)
    return loo
