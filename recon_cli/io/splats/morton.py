"""An order of points in which neighbours in the list are neighbours in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 21  # an axis; three make a word of 63


def morton_order(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Returns rows of points [N, 3] along a Z-order curve (Morton 1966) through their box.

    Points that share one of its 2^63 cells keep their order.
    """
    exact = points.astype(np.float64)
    low, high = exact.min(axis=0), exact.max(axis=0)
    width = np.where(high > low, high - low, 1)
    cells = ((exact - low) / width * ((1 << _BITS) - 1)).astype(np.uint64)
    x, y, z = (_spread(cells[:, axis]) for axis in range(3))
    return np.argsort(x | y << np.uint64(1) | z << np.uint64(2), kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Returns numbers of 21 bits with two zeros between each two bits."""
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
