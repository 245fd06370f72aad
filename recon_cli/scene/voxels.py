"""Cells of a regular grid, each with one number: three coordinates in a word of 63 bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BITS = 21  # of a coordinate
_HALF = 1 << (BITS - 1)  # cells on each side of the origin

# Side of the cells that get one point of a surface each, in median depths: 10 cm in a room. Half
# of it puts so many Gaussians on bare walls that the rest lacks them: .4 and .5 dB less in two
# rooms, with the same surfaces. Finer ones go where the error is, in the run.
SURFACE_CELL = 1 / 25


def number_cells(points: NDArray[np.floating], side: float) -> NDArray[np.int64]:
    """Returns the number of the cell of each point [P, 3], [P]; outermost cells reach on."""
    return join_places(np.clip(np.floor(points / side), -_HALF, _HALF - 1))


def join_places(places: NDArray[np.number]) -> NDArray[np.int64]:
    """Returns the numbers [N] of cells by their whole coordinates [N, 3]."""
    x, y, z = (places.astype(np.int64) + _HALF).T
    return np.asarray((x << 2 * BITS) | (y << BITS) | z)


def split_numbers(numbers: NDArray[np.int64]) -> NDArray[np.int32]:
    """Returns the coordinates [N, 3] of cells by their numbers [N]."""
    least = (1 << BITS) - 1
    parts = [numbers >> 2 * BITS, (numbers >> BITS) & least, numbers & least]
    return np.ascontiguousarray(np.stack(parts, axis=1) - _HALF, np.int32)
