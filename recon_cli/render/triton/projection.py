"""From raw parameters to records, and to the list of instances: one lane a Gaussian.

An instance is a Gaussian in a tile that its ellipse alpha = 1/255 meets on pixel centres. In a row
of tiles the ellipse covers an interval, known in closed form: its tiles are counted and written
without a test each. Everything stays on the device.
"""

from __future__ import annotations

import triton
import triton.language as tl

from recon_cli.render.contract import DILATION, NEAR
from recon_cli.render.triton.compositing import FLOATS, LOG2_ALPHA_MIN, LOG2E, SIDE, UNIT
from recon_cli.render.triton.gaussian import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    WIDTH,
    colors,
    direction,
    image_axes,
    position,
    project_axes,
    rotation,
    standard_deviations,
    unit_quaternion,
)

BLOCK = 128  # Gaussians a program
SHAPES = 8  # floats a Gaussian that only binning reads
CLIP = tl.constexpr(NEAR)
LOW_PASS = tl.constexpr(DILATION)
SHAPE = tl.constexpr(SHAPES)
SLACK = tl.constexpr(1e-3)  # in q and in pixels; culling keeps what rounding leaves in doubt
LARGE = tl.constexpr(1e30)  # a determinant or a pixel beyond it is of no use
INFINITE = tl.constexpr(3e38)


@triton.jit(do_not_specialize=("count", "colored"))
def project(means, quats, log_scales, logits, sh_dc, sh_rest, view, count, colored, records,
            shapes, centers, depths, touched, radii, broken,
            STRIDE: tl.constexpr, TERMS: tl.constexpr, BLOCK: tl.constexpr):
    """Projects `count` Gaussians and counts the tiles that each meets.

    The first `colored` of them have a row of STRIDE numbers in sh_rest, TERMS a channel in use.
    Written are

    Args:
        records: [N, FLOATS], see `compositing`.
        shapes: [N, SHAPE]: half width, half height, b / a, b / c and sqrt(reach det / c).
        centers: [N, 2] float64, pixels.
        depths: [N].
        touched: [N] int32, tiles.
        radii: [N], see `Statistics`.
        broken: [programs] int32, Gaussians that hold or become what is not finite.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    x, y, z = position(means, view, i, here)
    logit = tl.load(logits + i, mask=here, other=0.0)
    s0, s1, s2 = standard_deviations(log_scales, i, here)
    raw = tl.abs(logit)
    for k in tl.static_range(3):
        raw += tl.abs(tl.load(log_scales + 3 * i + k, mask=here, other=0.0))
        raw += tl.abs(tl.load(means + 3 * i + k, mask=here, other=0.0))
    for k in tl.static_range(4):
        raw += tl.abs(tl.load(quats + 4 * i + k, mask=here, other=0.0))
    finite = raw < INFINITE
    odds = tl.exp2(tl.minimum(-logit * LOG2E, 126.0))
    log2_opacity = -tl.log2(1.0 + odds)
    # the negated comparisons of NaN are false: what is not a number is not visible
    visible = here & finite & (z > CLIP) & (log2_opacity >= LOG2_ALPHA_MIN)
    z = tl.where(visible, z, 1.0)
    center_x = tl.load(view + FX) * x / z + tl.load(view + CX)
    center_y = tl.load(view + FY) * y / z + tl.load(view + CY)
    per_z = (1.0 / z).to(tl.float32)
    a0, a1, a2, b0, b1, b2 = image_axes(view, (x / z).to(tl.float32), (y / z).to(tl.float32), per_z)
    qw, qx, qy, qz, _ = unit_quaternion(quats, i, here)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw, qx, qy, qz)
    v00, v01, v02 = project_axes(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    v10, v11, v12 = project_axes(b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    v00, v01, v02, v10, v11, v12 = v00 * s0, v01 * s1, v02 * s2, v10 * s0, v11 * s1, v12 * s2
    square_x, b = v00 * v00 + v01 * v01 + v02 * v02, v00 * v10 + v01 * v11 + v02 * v12
    square_y = v10 * v10 + v11 * v11 + v12 * v12
    a, c = square_x + LOW_PASS, square_y + LOW_PASS
    # a c - b^2 cancels for needles; |vx x vy|^2 does not (Lagrange), and it is never negative
    w0, w1, w2 = v01 * v12 - v02 * v11, v02 * v10 - v00 * v12, v00 * v11 - v01 * v10
    det = w0 * w0 + w1 * w1 + w2 * w2 + (square_x + square_y + LOW_PASS) * LOW_PASS
    sound = ((det < LARGE) & (det > 0.0) & (tl.abs(center_x) < LARGE) & (tl.abs(center_y) < LARGE))

    to_x, to_y, to_z, _ = direction(means, view, i, here)
    red, green, blue = colors(
        sh_dc, sh_rest, i, here, visible & (i < colored), to_x, to_y, to_z, STRIDE, TERMS)
    lit = tl.abs(red) + tl.abs(green) + tl.abs(blue) < INFINITE
    whole = tl.where(visible, finite & lit & sound, finite & lit)
    tl.store(broken + tl.program_id(0), tl.sum(tl.where(here & (whole == 0), 1, 0)))
    visible = visible & sound & lit
    center_x, center_y = tl.where(visible, center_x, 0.0), tl.where(visible, center_y, 0.0)

    reach = (log2_opacity - LOG2_ALPHA_MIN) * (2.0 / LOG2E)  # 2 ln(255 o)
    reach = tl.maximum(reach, 0.0) * (1.0 + SLACK) + SLACK
    u_x = tl.sqrt(c / det) * UNIT
    record = records + i * FLOATS
    tl.store(record, u_x, mask=here)
    tl.store(record + 1, -b / c * u_x, mask=here)
    tl.store(record + 2, tl.rsqrt(c) * UNIT, mask=here)
    tl.store(record + 3, log2_opacity, mask=here)
    tl.store(record + 4, tl.maximum(red, 0.0), mask=here)
    tl.store(record + 5, tl.maximum(green, 0.0), mask=here)
    tl.store(record + 6, tl.maximum(blue, 0.0), mask=here)
    tl.store(record + 7, z.to(tl.float32), mask=here)
    extent_x, extent_y = tl.sqrt(reach * a), tl.sqrt(reach * c)
    shape = shapes + i * SHAPE
    tl.store(shape, extent_x, mask=here)
    tl.store(shape + 1, extent_y, mask=here)
    slope_y, slope_x = b / a, b / c
    tl.store(shape + 2, slope_y, mask=here)
    tl.store(shape + 3, slope_x, mask=here)
    half = tl.sqrt(reach * (det / c))
    tl.store(shape + 4, half, mask=here)
    tl.store(centers + 2 * i, center_x, mask=here)
    tl.store(centers + 2 * i + 1, center_y, mask=here)
    tl.store(depths + i, z.to(tl.float32), mask=here)

    low, high = rows_of(center_y, extent_y, view)
    low, high = tl.where(visible, low, 0), tl.where(visible, high, -1)
    tiles, row = low * 0, low
    while tl.max(high - row) >= 0:
        first, last = span(extent_x, extent_y, slope_y, slope_x, half, center_x, center_y, row,
                           view, here & (row <= high))
        tiles += tl.maximum(last - first + 1, 0)
        row += 1
    tl.store(touched + i, tiles, mask=here)
    middle, apart = 0.5 * (a + c), 0.5 * (a - c)
    radius = 3.0 * tl.sqrt(middle + tl.sqrt(apart * apart + b * b))
    inside = visible & (center_x + extent_x > 0.0) & (
        center_x - extent_x < tl.load(view + WIDTH)) & (center_y + extent_y > 0.0) & (
        center_y - extent_y < tl.load(view + HEIGHT))
    tl.store(radii + i, tl.where(inside, radius, 0.0), mask=here)


@triton.jit
def rows_of(center_y, extent_y, view):
    """Returns the first and the last row of tiles that a box of half height `extent_y` meets."""
    # pixel centres lie at +0.5; held within the image before the cast, which cannot hold more
    top = tl.floor((tl.ceil(center_y - extent_y - 0.5 - SLACK)) / SIDE)
    bottom = tl.floor((tl.floor(center_y + extent_y - 0.5 + SLACK)) / SIDE)
    rows = tl.ceil(tl.load(view + HEIGHT) / SIDE)
    return (tl.minimum(tl.maximum(top, 0.0), rows).to(tl.int32),
            tl.minimum(tl.maximum(bottom, -1.0), rows - 1.0).to(tl.int32))


@triton.jit
def span(extent_x, extent_y, slope_y, slope_x, half, center_x, center_y, row, view, here):
    """Returns the first and the last tile of a row that ellipses meet; last < first for none.

    Between two heights the ellipse reaches farthest right at its rightmost point, or at the height
    that is nearest to it. The first five arguments are what `project` writes into `shapes`.
    """
    top = (row * SIDE + 0.5 - center_y).to(tl.float32)
    low, high = tl.maximum(top, -extent_y), tl.minimum(top + (SIDE - 1), extent_y)
    rightmost = slope_y * extent_x  # the height of the rightmost point
    right_at = tl.minimum(tl.maximum(rightmost, low), high)
    left_at = tl.minimum(tl.maximum(-rightmost, low), high)
    across = right_at / extent_y
    right = slope_x * right_at + half * tl.sqrt(tl.maximum(1.0 - across * across, 0.0))
    across = left_at / extent_y
    left = slope_x * left_at - half * tl.sqrt(tl.maximum(1.0 - across * across, 0.0))
    right, left = tl.minimum(right, extent_x), tl.maximum(left, -extent_x)
    columns = tl.ceil(tl.load(view + WIDTH) / SIDE)
    # the box is wider by what float32 may lose of an extent
    first = tl.ceil(center_x + left - 0.5 - SLACK)
    last = tl.floor(center_x + right - 0.5 + SLACK)
    meets = here & (low <= high + SLACK) & (first <= last)
    first = tl.minimum(tl.maximum(tl.floor(first / SIDE), 0.0), columns).to(tl.int32)
    last = tl.minimum(tl.maximum(tl.floor(last / SIDE), -1.0), columns - 1.0).to(tl.int32)
    return first, tl.where(meets, last, first - 1)


@triton.jit(do_not_specialize=("count", "tiles_x"))
def list_tiles(shapes, centers, depths, starts, view, count, tiles_x, keys, owners,
               BLOCK: tl.constexpr):
    """Writes the instances of each Gaussian into its slots.

    `starts` [N + 1] int32 is the first slot of each; without slots a Gaussian is left out. Written
    are `keys` [E] int64, the tile and in the lower half the bits of the depth, which is positive,
    and `owners` [E] int32, the Gaussian.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    slot, end = tl.load(starts + i, mask=here, other=0), tl.load(starts + i + 1, mask=here, other=0)
    here = here & (slot < end)
    center_x = tl.load(centers + 2 * i, mask=here, other=0.0)
    center_y = tl.load(centers + 2 * i + 1, mask=here, other=0.0)
    shape = shapes + i * SHAPE
    extent_x = tl.load(shape, mask=here, other=0.0)
    extent_y = tl.load(shape + 1, mask=here, other=1.0)
    slope_y = tl.load(shape + 2, mask=here, other=0.0)
    slope_x = tl.load(shape + 3, mask=here, other=0.0)
    half = tl.load(shape + 4, mask=here, other=0.0)
    depth = tl.load(depths + i, mask=here, other=1.0).to(tl.int32, bitcast=True).to(tl.int64)
    low, high = rows_of(center_y, extent_y, view)
    high = tl.where(here, high, low - 1)
    row = low
    while tl.max(high - row) >= 0:
        tile, last = span(extent_x, extent_y, slope_y, slope_x, half, center_x, center_y, row,
                          view, here & (row <= high))
        while tl.max(last - tile) >= 0:
            more = tile <= last
            key = (row * tiles_x + tile).to(tl.int64) * 4294967296 + depth
            tl.store(keys + slot, key, mask=more)
            tl.store(owners + slot, i.to(tl.int32), mask=more)
            slot += more.to(tl.int32)
            tile += 1
        row += 1


@triton.jit(do_not_specialize=("count", "tiles_x"))
def place(keys, slots, owners, centers, records, starts, count, tiles_x, members, offsets,
          BLOCK: tl.constexpr):
    """Writes the inputs of compositing for each instance, in its order.

    `keys` [E] int64 are sorted, `slots` [E] int64 the slot of each key, `owners` [E] int32 the
    Gaussian of each slot; the last of `starts` [count + 1] int32 is how many instances there are.
    Written are `members` [E] int32, the Gaussian, and `offsets` [E, 2], u and v at the tile's first
    pixel.
    """
    e = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = e < tl.load(starts + count)
    tile = (tl.load(keys + e, mask=here, other=0) >> 32).to(tl.int32)
    owner = tl.load(owners + tl.load(slots + e, mask=here, other=0), mask=here, other=0)
    i = owner.to(tl.int64)
    dx = tile % tiles_x * SIDE + 0.5 - tl.load(centers + 2 * i, mask=here, other=0.0)
    dy = tile // tiles_x * SIDE + 0.5 - tl.load(centers + 2 * i + 1, mask=here, other=0.0)
    record = records + i * FLOATS
    u_x, u_y = tl.load(record, mask=here, other=0.0), tl.load(record + 1, mask=here, other=0.0)
    v_y = tl.load(record + 2, mask=here, other=0.0)
    # in float64: far from the mean of a needle the two terms of u nearly cancel
    u = u_x.to(tl.float64) * dx + u_y.to(tl.float64) * dy
    tl.store(members + e, owner, mask=here)
    tl.store(offsets + 2 * e, u.to(tl.float32), mask=here)
    tl.store(offsets + 2 * e + 1, (v_y.to(tl.float64) * dy).to(tl.float32), mask=here)


@triton.jit(do_not_specialize=("count", "tiles"))
def tile_starts(keys, count, tiles, first, BLOCK: tl.constexpr):
    """Writes where the instances of each tile begin, `first` [tiles + 1] int32.

    `keys` [count] int64 are sorted; behind those of the last tile may be greater ones.
    """
    e = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(keys + e, mask=e < count, other=0)
    before = tl.load(keys + e - 1, mask=(e > 0) & (e <= count), other=0)
    last = tl.where(e < count, tl.minimum((key >> 32).to(tl.int32), tiles), tiles)
    tile = tl.where(e > 0, tl.minimum((before >> 32).to(tl.int32), tiles) + 1, 0)
    last = tl.where(e <= count, last, tile - 1)
    while tl.max(last - tile) >= 0:
        tl.store(first + tile, e.to(tl.int32), mask=tile <= last)
        tile += 1
