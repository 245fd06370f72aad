"""The backdrop: one colour behind all Gaussians of a scene; for other programs, a sphere of them.

On black, whatever the Gaussians leave uncovered is a dark gap: the training views teach them to
close it there, and views beside those see between them. On grey such a gap costs little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from recon_cli.scene.similarity import Similarity

SPHERE_GAUSSIANS = 1024  # 6 degrees apart; more where they would be too large for a format
SPHERE_OPACITY = 0.99  # the rasterizers clamp alpha there
_MOST = 1 << 15
AT_ONCE = 256  # more of them: they fill chunks of their own in a .compressed.ply
# of the distance of what is farthest: depth is along the axis of a camera, so that Gaussians aside,
# which reach into the middle, would hide what is not much nearer
_BEHIND = 2.0
_SPREAD = 0.8  # of the distance between neighbours: the standard deviation


@dataclass(frozen=True)
class Backdrop:
    """A colour behind all Gaussians, and from where it is looked at."""

    red: float  # in [0, 1], like the others
    green: float
    blue: float
    x: float  # middle of the cameras, world units
    y: float
    z: float
    reach: float  # within which of it they are, world units

    @staticmethod
    def from_numbers(numbers: Sequence[float]) -> Backdrop:
        """Returns the backdrop of the seven numbers in order.

        Raises:
            ValueError: they are not seven, or one is not finite.
        """
        if len(numbers) != 7 or not np.isfinite(numbers).all():
            raise ValueError(f"no backdrop: {numbers}")
        red, green, blue, x, y, z, reach = numbers
        return Backdrop(red, green, blue, x, y, z, reach)

    @staticmethod
    def behind(grey: float, cameras: NDArray[np.float64]) -> Backdrop:
        """Returns a grey one, 0 to 1, for cameras [C, 3]."""
        middle = cameras.mean(axis=0)
        reach = np.linalg.norm(cameras - middle, axis=1).max()
        return Backdrop.from_numbers([grey, grey, grey, *middle.tolist(), float(reach)])

    @property
    def color(self) -> tuple[float, float, float]:
        """RGB in [0, 1]."""
        return self.red, self.green, self.blue

    @property
    def numbers(self) -> tuple[float, ...]:
        """All of it, for `of`."""
        return astuple(self)

    def moved(self, similarity: Similarity) -> Backdrop:
        """Returns the same in another world."""
        middle = similarity.points(np.array([self.x, self.y, self.z]))
        return Backdrop.from_numbers(
            [*self.color, *middle.tolist(), float(similarity.scale * self.reach)])

    def sphere(
        self, means: NDArray[np.floating], largest: float = np.inf
    ) -> tuple[NDArray[np.float64], float]:
        """Returns a sphere behind the cameras and all centres [N, 3] that are finite.

        The first are the centres [K, 3] of its Gaussians, float64, the second their standard
        deviation, which leaves no gaps. K is SPHERE_GAUSSIANS, or so many more, up to a limit,
        that the second is at most `largest`.
        """
        middle = np.array([self.x, self.y, self.z])
        finite = means[np.isfinite(means).all(axis=1)].astype(np.float64)
        farthest = np.linalg.norm(finite - middle, axis=1).max(initial=self.reach)
        radius = float(_BEHIND * farthest) or 1.0
        enough = 4 * np.pi * (_SPREAD * radius / largest) ** 2
        count = int(np.clip(AT_ONCE * np.ceil(enough / AT_ONCE), SPHERE_GAUSSIANS, _MOST))
        scale = float(_SPREAD * radius * np.sqrt(4 * np.pi / count))
        return middle + radius * fibonacci_sphere(count), scale


def enclosing(parts: Sequence[Backdrop | None]) -> Backdrop | None:
    """Returns the backdrop of a scene made of parts: of the first one's colour, for all cameras."""
    known = list(dict.fromkeys(part for part in parts if part is not None))
    if len(known) < 2:
        return known[0] if known else None
    middles = np.array([[part.x, part.y, part.z] for part in known])
    middle = middles.mean(axis=0)
    reach = np.linalg.norm(middles - middle, axis=1) + [part.reach for part in known]
    return Backdrop.from_numbers([*known[0].color, *middle.tolist(), float(reach.max())])


def fibonacci_sphere(n: int) -> NDArray[np.float64]:
    """Returns n unit vectors spread evenly, [n, 3] (Swinbank and Purser 2006)."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    around = np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(around), flat * np.sin(around), z], axis=1)
