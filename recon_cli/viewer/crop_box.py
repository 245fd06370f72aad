"""The crop box of the viewer, in the numbers that `recon export --crop` takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.splats import Splats

_SHARE = 0.05  # of the Gaussians outside the initial box at either end of each axis
_MARGIN = 0.1  # of its sides
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1]


@dataclass(frozen=True)
class CropBox:
    """An axis-aligned box in world units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @staticmethod
    def between(low: Sequence[float], high: Sequence[float]) -> CropBox:
        """Returns the box of two corners, rounded as `arguments` writes them."""
        first, second = ((float(_format(x)), float(_format(y)), float(_format(z)))
                         for x, y, z in (low, high))
        return CropBox(first, second)

    @property
    def arguments(self) -> str:
        """The six numbers for `recon export --crop`."""
        return " ".join(_format(value) for value in (*self.low, *self.high))

    @property
    def is_valid(self) -> bool:
        """Whether its low corner is below its high corner."""
        return all(a < b for a, b in zip(self.low, self.high, strict=True))

    def contains(self, splats: Splats) -> NDArray[np.bool_]:
        """Returns [N] which centres are inside, its faces included."""
        low, high = splats.means.new_tensor(self.low), splats.means.new_tensor(self.high)
        inside: NDArray[np.bool_] = (
            (splats.means >= low) & (splats.means <= high)).all(dim=1).numpy()
        return inside

    def edges(self) -> NDArray[np.float32]:
        """Returns its edges [12, 2, 3]."""
        corners = np.where(_CORNERS, self.high, self.low)
        return np.asarray(corners[np.array(_EDGES)], np.float32)


def box_around(splats: Splats) -> CropBox:
    """Returns the initial box: 90% of the Gaussians along each axis, plus a tenth of its sides."""
    if not len(splats):
        return CropBox((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    low, high = np.quantile(splats.means.numpy(), [_SHARE, 1 - _SHARE], axis=0)
    margin = _MARGIN * (high - low) + 1e-3
    return CropBox.between((low - margin).tolist(), (high + margin).tolist())


def _format(value: float) -> str:
    return f"{value:.4g}"
