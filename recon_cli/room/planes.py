"""Large planes in a surface: walls, floor and ceiling.

The surface is given as points with normals and the area that each stands for. A wall that was
reconstructed badly is a band, not a sheet: its plane is where the band is centred, and how far it
can be trusted is part of the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.statistics import OUTLIER_SIGMAS, robust_sigma

_TRIALS = 400  # candidates for each plane, each through one point along its normal
_SAMPLE = 12_000  # points that candidates are scored on
LEAST_COSINE = 0.8  # between a plane and the normals of its points: reconstructed walls are bumpy
_MOST_PLANES = 24
_LEAST_SHARE = 0.015  # of the total area; a wall of a room is some per cent, a table less
_STEPS = 8  # of the reweighted fit; it converges in about four


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane n x = h."""

    normal: NDArray[np.float64]  # [3] unit vector, towards the side that is seen
    offset: float  # h, world units
    area: float  # of the surface in it
    spread: float  # robust standard deviation of its points from it, world units
    rows: NDArray[np.int64]  # points in it

    def heights(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the signed distances [N] of points [N, 3]."""
        return points @ self.normal - self.offset


def find_planes(
    points: NDArray[np.float64],  # [N, 3]
    normals: NDArray[np.float64],  # [N, 3] unit vectors
    areas: NDArray[np.float64],  # [N]
    band: float,  # half the thickness of a reconstructed wall, world units
) -> list[Plane]:
    """Returns the planes of most area, largest first (sequential RANSAC, then Tukey's weights)."""
    generator = np.random.default_rng(0)
    left = np.arange(len(points))
    total = float(areas.sum())
    planes: list[Plane] = []
    while len(planes) < _MOST_PLANES and len(left) >= 3:
        chosen = generator.choice(left, min(_SAMPLE, len(left)), replace=False)
        trials = chosen[generator.permutation(len(chosen))[:_TRIALS]]
        apart = np.abs(points[chosen] @ normals[trials].T
                       - (points[trials] * normals[trials]).sum(1))
        alike = normals[chosen] @ normals[trials].T > LEAST_COSINE
        scores = ((apart < band) & alike).T.astype(np.float64) @ areas[chosen]
        best = trials[scores.argmax()]
        plane = _fit(points, normals, areas, left, normals[best],
                     float(points[best] @ normals[best]), band)
        if plane is None or plane.area < _LEAST_SHARE * total:
            break
        planes.append(plane)
        near = np.abs(plane.heights(points[left])) < 2 * band
        left = left[~(near & (normals[left] @ plane.normal > 0.5))]
    return sorted(planes, key=lambda plane: -plane.area)


def _fit(
    points: NDArray[np.float64], normals: NDArray[np.float64], areas: NDArray[np.float64],
    left: NDArray[np.int64], normal: NDArray[np.float64], offset: float, band: float,
) -> Plane | None:
    for step in range(_STEPS):
        share = (points[left] @ normal - offset) / (band * (2 if step < _STEPS // 2 else 1.5))
        inside = (np.abs(share) < 1) & (normals[left] @ normal > LEAST_COSINE)
        rows = left[inside]
        if len(rows) < 3:
            return None
        weights = areas[rows] * (1 - share[inside] ** 2) ** 2
        middle = np.average(points[rows], axis=0, weights=weights)
        offsets = (points[rows] - middle) * np.sqrt(weights)[:, None]
        fitted = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
        normal = fitted if fitted @ normal > 0 else -fitted
        offset = float(middle @ normal)
    spread = robust_sigma(points[rows] @ normal - offset, areas[rows])
    return Plane(normal, offset, float(areas[rows].sum()), spread, rows)


# Of the confirmation of a plane by sparse points:
_LEAST_POINTS = 60
_LEAST_PEAK = 0.25  # share of the points near a plane that lie in its densest layer
_SURE_PEAK = 0.5  # share from which on they may lie as far off as they are looked for
_LEAST_PARALLEL = 0.99  # cosine of the turn
_CELL = 6.0  # bands, side of the cells in which points count as over the plane
_LAYER = 0.4  # of a band, thickness of a wall as points show it


def confirm_all(
    planes: list[Plane], surface: NDArray[np.float64], points: NDArray[np.float64], band: float
) -> list[Plane | None]:
    """Returns each plane as `confirm` fits it; leaning ones also upright.

    Where the surface of a plane is too rough to say how it leans, as of a blank ceiling, it is
    tried parallel to the confirmed planes that it is nearly parallel to.
    """
    confirmed = [confirm(plane, surface, points, band) for plane in planes]
    normals = [plane.normal for plane in confirmed if plane is not None]
    for number, plane in enumerate(planes):
        cosines = [float(normal @ plane.normal) for normal in normals]
        if confirmed[number] is None and cosines:
            best = int(np.argmax(np.abs(cosines)))
            if abs(cosines[best]) > _LEAST_PARALLEL:
                normal = np.sign(cosines[best]) * normals[best]
                middle = surface[plane.rows].mean(axis=0)
                confirmed[number] = confirm(
                    replace(plane, normal=normal, offset=float(middle @ normal)),
                    surface, points, band)
    return confirmed


def confirm(
    plane: Plane,
    surface: NDArray[np.float64],  # [N, 3] the points that the plane was found in
    points: NDArray[np.float64],  # [P, 3] triangulated points
    band: float,  # as in `find_planes`
) -> Plane | None:
    """Returns the plane moved to the layer of triangulated points in it; None where there is none.

    Gaussians of a wall without texture lie anywhere within a band; points are triangulated, each by
    its own views, and scatter about the wall itself.
    """
    first = np.cross(plane.normal, np.eye(3)[np.argmin(np.abs(plane.normal))])
    first /= np.linalg.norm(first)
    along = np.stack([first, np.cross(plane.normal, first)], axis=1)
    window = 4 * band
    near = points[np.abs(plane.heights(points)) < window]
    cells = np.floor(surface[plane.rows] @ along / (_CELL * band)).astype(np.int64)
    own = np.unique(cells, axis=0)
    mine = np.floor(near @ along / (_CELL * band)).astype(np.int64)
    rows = np.unique(np.concatenate([own, mine]), axis=0, return_inverse=True)[1].reshape(-1)
    near = near[np.isin(rows[len(own):], rows[:len(own)])]
    if len(near) < _LEAST_POINTS:
        return None
    layer = _LAYER * band
    heights = plane.heights(near)
    edges = np.arange(-window, window + layer / 2, layer / 2)
    counts = np.histogram(heights, edges)[0]
    layers = counts[:-1] + counts[1:]
    peak = int(layers.argmax())
    if layers[peak] < max(_LEAST_PEAK * len(near), _LEAST_POINTS / 2):
        return None
    normal, offset = plane.normal, plane.offset + float(edges[peak + 1])
    for width in (2.0, 2.0, 1.5, 1.5, 1.0):
        share = (near @ normal - offset) / (width * layer)
        inside = np.abs(share) < 1
        if inside.sum() < 3:
            return None
        weights = (1 - share[inside] ** 2) ** 2
        middle = np.average(near[inside], axis=0, weights=weights)
        offsets = (near[inside] - middle) * np.sqrt(weights)[:, None]
        fitted = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
        normal = fitted if fitted @ normal > 0 else -fitted
        offset = float(middle @ normal)
    middle = np.average(surface[plane.rows], axis=0)
    shift = abs(float(middle @ normal) - offset)
    sure = layers[peak] >= _SURE_PEAK * len(near)
    if (shift > max(OUTLIER_SIGMAS * plane.spread, layer) and not sure) or (
            normal @ plane.normal < _LEAST_PARALLEL):
        return None
    spread = robust_sigma(near[inside] @ normal - offset)
    return Plane(normal, offset, plane.area, spread, plane.rows)
