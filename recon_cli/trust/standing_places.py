"""Where a person with a camera can stand: over the floor, at eye height, in space seen to be free.

Space is free where rays from training cameras to what they show pass through. A place is good where
no surface stands between knees and eyes, and a way over such places leads to a camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.ndimage import binary_dilation, label
from scipy.spatial import cKDTree

from recon_cli.scene.splats import Splats
from recon_cli.trust.support import Support
from recon_cli.trust.surface import surface_rows

_CELLS_PER_EYE = 8  # cells from the floor to the eyes: about 20 cm each
_KNEE, _OVER = 0.3, 1.15  # of the eye height: what stands in between is in the way
_FAR = 2.5  # eye heights from the nearest camera; farther is guessed, or beyond a window
_RAYS = 1_500  # a view, at most
_STEPS = 48  # along a ray
_SHORT = 0.92  # of a ray that counts as free: its end is a surface
_CLEAR = 3  # cells to what stands in the way: half a metre, as somebody with a camera keeps
_LEAST_RAYS = 3  # through a free cell
_LEAST_SOLID = 2.0  # sum of the opacities of an obstacle in one cell
_LOWEST = 0.02  # share of the surface that may lie under a floor that was not found
_LEAST_EYE = 0.1  # of the median distance of the surface: cameras lower than that lie on the floor

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StandingPlaces:
    """Places to stand at, in world units."""

    eyes: Array  # [P, 3]
    up: Array  # [3]
    floor: float  # height along `up`
    eye: float  # height of the eyes over the floor


def find_places(
    splats: Splats, support: Support, up: Array, floor: float | None, cameras: Array, *, most: int,
) -> StandingPlaces:
    """Returns at most so many places, spread evenly; none where no space is free.

    `up` [3] is a unit vector, `floor` the height of the floor along it, None where none was found:
    then the lowest surfaces are. `cameras` are [C, 3].
    """
    rows = surface_rows(splats, support).cpu()
    means = splats.means.detach().cpu().double().numpy()
    surface = means[rows.numpy()]
    solid = splats.opacities.detach().cpu().double().numpy()[rows.numpy()]
    heights = surface @ up if len(surface) else np.zeros(1)
    if floor is None:
        floor = float(np.quantile(heights, _LOWEST))
    reach = float(np.median(np.linalg.norm(surface - cameras.mean(0), axis=1))) if len(
        surface) else 1.0
    eye = max(float(np.median(cameras @ up)) - floor, _LEAST_EYE * reach)
    axes = plan_axes(up)
    grid = _Grid.around(cameras @ axes.T, eye)
    free = _carve(grid, means, support, axes, up, floor, eye)
    between = (heights > floor + _KNEE * eye) & (heights < floor + _OVER * eye)
    blocked = grid.count(surface[between] @ axes.T, solid[between]) >= _LEAST_SOLID if len(
        surface) else np.zeros_like(free)
    own = grid.count(cameras @ axes.T) > 0
    # where a camera was somebody stood, whatever floats there
    good = (free & ~binary_dilation(blocked, iterations=_CLEAR)) | own
    parts, _ = label(good, np.ones((3, 3)))
    good &= np.isin(parts, np.unique(parts[own & good]))
    flat = grid.centers(good)
    flat = flat[cKDTree(cameras @ axes.T).query(flat)[0] <= _FAR * eye] if len(flat) else flat
    eyes = _spread(flat, most) @ axes + (floor + eye) * up
    return StandingPlaces(eyes, up, floor, eye)


def plan_axes(up: Array) -> Array:
    """Returns two level unit vectors [2, 3]: x and y where z is up."""
    right = np.eye(3)[np.argmin(np.abs(up))] if abs(up[2]) < 1 - 1e-9 else np.array([1.0, 0, 0])
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)])


@dataclass(frozen=True, eq=False)
class _Grid:
    """Square cells of the plan."""

    low: Array  # [2]
    cell: float
    shape: tuple[int, int]

    @staticmethod
    def around(cameras: Array, eye: float) -> _Grid:
        """Returns the cells within reach of cameras [C, 2]; larger ones where they are very far."""
        low, high = cameras.min(0) - _FAR * eye, cameras.max(0) + _FAR * eye
        cell = max(eye / _CELLS_PER_EYE, float((high - low).max()) / 400)
        across, along = np.ceil((high - low) / cell).astype(int) + 1
        return _Grid(low, cell, (int(across), int(along)))

    def count(self, places: Array, weights: Array | None = None) -> Array:
        """Returns how many of `places` [K, 2], or what weight of them, lie in each cell."""
        at = np.floor((places - self.low) / self.cell).astype(np.int64)
        inside = ((at >= 0) & (at < self.shape)).all(axis=-1)
        flat = at[inside] @ np.array([self.shape[1], 1])
        counts = np.bincount(flat, None if weights is None else weights[inside],
                             minlength=self.shape[0] * self.shape[1])
        return np.asarray(counts, np.float64).reshape(self.shape)

    def centers(self, cells: NDArray[np.bool_]) -> Array:
        """Returns the middles [K, 2] of some cells."""
        return np.asarray((np.argwhere(cells) + 0.5) * self.cell + self.low)


def _carve(
    grid: _Grid, means: Array, support: Support, axes: Array, up: Array, floor: float, eye: float
) -> NDArray[np.bool_]:
    """Returns the cells that rays pass through between knees and eyes."""
    counts = np.zeros(grid.shape)
    shares = np.linspace(0, _SHORT, _STEPS)[:, None, None]
    for rows, center in zip(support.rows, support.centers, strict=True):
        sample = rows.cpu().numpy()[:: max(1, len(rows) // _RAYS)]
        along = center + shares * (means[sample] - center)  # [S, K, 3]
        height = along @ up - floor
        inside = (height > _KNEE * eye) & (height < _OVER * eye)
        counts += grid.count(along[inside] @ axes.T)
    return np.asarray(counts >= _LEAST_RAYS)


def _spread(places: Array, most: int) -> Array:
    """Returns at most so many of `places` [K, 2], each in the middle of an equal share of them."""
    if len(places) <= most:
        return places
    middles, _ = kmeans2(places, most, minit="++", rng=np.random.default_rng(0))
    nearest = np.unique(cKDTree(places).query(middles)[1])  # where the middle itself is not free
    return np.asarray(places[nearest])
