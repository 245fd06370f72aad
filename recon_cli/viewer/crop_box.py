"""The box that Gaussians are cut with: what `recon export --crop` takes, in numbers and words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.splats import Splats

_SHARE = 0.05  # of the Gaussians left out at either end of each axis by the first box
_MARGIN = 0.1  # of its sides
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1]


@dataclass(frozen=True)
class Box:
    """A box along the axes of the world, in world units.

    Attributes:
        low: its lowest corner.
        high: its highest corner.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @staticmethod
    def between(low: Sequence[float], high: Sequence[float]) -> Box:
        """Returns the box of two corners, as it is written: what is shown is what is cut."""
        first, second = ((float(_word(x)), float(_word(y)), float(_word(z)))
                         for x, y, z in (low, high))
        return Box(first, second)

    @property
    def words(self) -> str:
        """The six numbers as `recon export --crop` takes them."""
        return " ".join(_word(value) for value in (*self.low, *self.high))

    @property
    def holds_something(self) -> bool:
        """Whether it is a box at all."""
        return all(a < b for a, b in zip(self.low, self.high, strict=True))

    def inside(self, splats: Splats) -> NDArray[np.bool_]:
        """Returns which centres lie in it, its sides included, [N]."""
        low, high = splats.means.new_tensor(self.low), splats.means.new_tensor(self.high)
        found: NDArray[np.bool_] = (
            (splats.means >= low) & (splats.means <= high)).all(dim=1).numpy()
        return found

    def edges(self) -> NDArray[np.float32]:
        """Returns its edges [12, 2, 3]."""
        corners = np.where(_CORNERS, self.high, self.low)
        return np.asarray(corners[np.array(_EDGES)], np.float32)


def box_around(splats: Splats) -> Box:
    """Returns a box around the room: nine tenths along each axis, and a tenth of its sides more."""
    if not len(splats):
        return Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    low, high = np.quantile(splats.means.numpy(), [_SHARE, 1 - _SHARE], axis=0)
    margin = _MARGIN * (high - low) + 1e-3
    return Box.between((low - margin).tolist(), (high + margin).tolist())


def _word(value: float) -> str:
    return f"{value:.4g}"
