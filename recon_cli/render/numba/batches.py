"""Batches: the next instances of a tile, brought into the tile's own coordinates."""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.kernel import inlined
from recon_cli.render.numba.simd import LANES
from recon_cli.render.numba.simd_functions import (
    floor,
    lane_numbers,
    maximum,
    minimum,
    select,
    square_root,
)
from recon_cli.render.numba.simd_memory import load, store
from recon_cli.render.numba.soa import (
    BATCH,
    BLUE,
    DEPTH,
    EXTENT_X,
    EXTENT_Y,
    FAR,
    GREEN,
    HALF_Y,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_X_LOW,
    MEAN_Y,
    MEAN_Y_LOW,
    RECORD,
    RED,
    SLOPE_Y,
    TILE_HEIGHT,
    TILE_WIDTH,
    U_X,
    U_Y,
    V_Y,
)

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
