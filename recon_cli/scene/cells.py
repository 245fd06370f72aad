"""A cell: the part of a large scene that a block of its training owns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@dataclass(frozen=True, eq=False)
class Cell:
    """The part of space that a block owns: places nearest to one of its points."""

    points: NDArray[np.float64]  # [P, 3] of the whole scene, world units
    owned: NDArray[np.bool_]  # [P] those of the block

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree  # half a second, which a scene without cells saves

        return cKDTree(self.points)

    def owns(self, positions: NDArray[np.floating]) -> NDArray[np.bool_]:  # [N, 3] -> [N]
        """Returns which positions lie in the cell; each lies in one of a scene's cells."""
        if not len(positions):
            return np.zeros(0, np.bool_)
        return np.asarray(self.owned[self._tree.query(positions)[1]])
