"""Floor and walls in a cloud of sparse points, once it is known roughly where up is.

Points on a plane have the same height over it: where the points are lined up along its normal, a
histogram of the heights has a sharp peak. Both searches try directions and keep the sharpest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.statistics import COARSE_SAMPLE, FINE_SAMPLE, LEAST_SAMPLE

# Thickness of a surface, as a share of the median distance of the points from their middle: 2.5 cm
# in the rendered rooms, where points on the floor scatter by 1 to 2 cm.
_THICKNESS = 0.015
_REACH = 4.0  # median distances beyond which a point is taken for a stray
_MAX_BELOW = 0.05  # share under a floor; 0.2% and 0.3% in rendered rooms, more if it mirrors
_MIN_SHARE = 0.04  # of the points; 23% and 28% in the rendered rooms
_MIN_CONTRAST = 2.0  # times as dense as the space right above; 14 and 11 in the rendered rooms
_MIN_WIDTH = 0.2  # of the median distance, across its narrow side: shelves and edges are not floors
# Peakiness of the best heading over that of the middling one. Measured: 2.1 and 3.0 in the rendered
# rooms, 1.08 around a toy on a bed, up to 1.07 in clutter without walls.
_MIN_WALLS = 1.3


@dataclass(frozen=True, eq=False)
class Floor:
    """The lowest large horizontal surface."""

    up: NDArray[np.float64]  # [3] unit normal, away from what lies below
    height: float  # of the surface along `up`, in world units
    share: float  # of the points that lie in it
    below: float  # share of the points under it
    contrast: float  # density of points in it over that right above it


@dataclass(frozen=True, eq=False)
class Walls:
    """The direction that walls and furniture share."""

    along: NDArray[np.float64]  # [3] horizontal unit vector; the other one is at right angles
    strength: float  # how much sharper the points line up along it than along a middling direction
    found: bool  # whether that is enough to rule out chance


def find_floor(
    points: NDArray[np.float64], centers: NDArray[np.float64], up: NDArray[np.float64], *,
    cone_deg: float,
) -> Floor | None:
    """Returns the lowest large plane below the cameras `centers` [C, 3], None where there is none.

    Its normal lies within `cone_deg` of the unit vector `up`.
    """
    near, size = _near(points)
    if len(near) < LEAST_SAMPLE:
        return None
    thick = _THICKNESS * size
    # the floor is a quarter of the points; the fit takes all
    sample = near[:: max(1, len(near) // COARSE_SAMPLE)]
    normal, height = up, 0.0
    for reach, step in ((cone_deg, 1.0), (1.0, 0.25)):  # a degree moves the rim by two thicknesses
        tilts = _tilt_directions(normal, reach, step)
        peaks = [_lowest_peak(sample @ tilt, centers @ tilt, thick) for tilt in tilts]
        best = max(range(len(tilts)), key=lambda row: peaks[row][0])
        count, height = peaks[best]
        if count < 0:
            return None
        normal = tilts[best]
    normal, height = _fit_plane(near, normal, height, thick)
    if normal @ up < np.cos(np.radians(cone_deg)):
        return None
    floor = _measure_floor(near, normal, height, thick)
    wide = _width(near, floor, thick) >= _MIN_WIDTH * size
    good = bool(
        floor.share >= _MIN_SHARE and floor.below <= _MAX_BELOW
        and floor.contrast >= _MIN_CONTRAST and wide)
    return floor if good else None


def find_walls(points: NDArray[np.float64], up: NDArray[np.float64]) -> Walls:
    """Returns the horizontal direction along which the points line up best."""
    near, size = _near(points)
    # walls are a few per cent of the points each
    near = near[:: max(1, len(near) // FINE_SAMPLE)]
    first = np.linalg.svd(up[None])[2][1]
    if len(near) < LEAST_SAMPLE:
        return Walls(first, 1.0, False)
    flat = np.stack([near @ first, near @ np.cross(up, first)], axis=1)
    bins = _THICKNESS * size
    degrees = np.arange(0.0, 90.0)
    scores = np.array([_peakiness(flat, angle, bins) for angle in degrees])
    best = degrees[scores.argmax()]
    fine = best + np.linspace(-1, 1, 21)
    heading = np.radians(fine[np.argmax([_peakiness(flat, angle, bins) for angle in fine])])
    along = np.cos(heading) * first + np.sin(heading) * np.cross(up, first)
    strength = float(scores.max() / np.median(scores))
    return Walls(along, strength, strength >= _MIN_WALLS)


def _near(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Returns the points without strays, and the median distance from their middle."""
    if not len(points):
        return points, 0.0
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    size = float(np.median(distances))
    return points[distances <= _REACH * size], size


def _tilt_directions(up: NDArray[np.float64], reach: float, step: float) -> NDArray[np.float64]:
    """Returns unit vectors [K, 3] on a grid of `step` degrees, up to `reach` degrees from `up`."""
    first = np.linalg.svd(up[None])[2][1]
    line = np.radians(np.arange(-np.floor(reach / step), np.floor(reach / step) + 1) * step)
    a, b = (grid.ravel() for grid in np.meshgrid(line, line))
    inside = a * a + b * b <= np.radians(reach) ** 2 + 1e-12
    directions = up + np.outer(a[inside], first) + np.outer(b[inside], np.cross(up, first))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _lowest_peak(
    heights: NDArray[np.float64], cameras: NDArray[np.float64], thick: float
) -> tuple[int, float]:
    """Returns count and height of the fullest layer below the cameras with little under it."""
    lowest = heights.min()
    counts = np.bincount(((heights - lowest) / thick).astype(np.int64))
    layers = counts[:-1] + counts[1:] if len(counts) > 1 else counts
    under = np.concatenate([[0, 0], np.cumsum(counts)])[: len(layers)]  # one bin of tolerance
    tops = lowest + thick * (np.arange(len(layers)) + 2)
    allowed = (under <= _MAX_BELOW * len(heights)) & (tops < cameras.min())
    if not allowed.any():
        return -1, 0.0
    best = int(np.argmax(np.where(allowed, layers, -1)))
    return int(layers[best]), float(tops[best] - thick)


def _fit_plane(
    points: NDArray[np.float64], normal: NDArray[np.float64], height: float, thick: float
) -> tuple[NDArray[np.float64], float]:
    """Returns the plane through the points within two, then one thickness (Tukey's weights)."""
    for band in (2.0, 2.0, 2.0, 1.5, 1.5, 1.5, 1.5, 1.5):
        share = (points @ normal - height) / (band * thick)
        inside = np.abs(share) < 1
        weights = (1 - share[inside] ** 2) ** 2
        if inside.sum() < 3:
            break
        middle = np.average(points[inside], axis=0, weights=weights)
        offsets = (points[inside] - middle) * np.sqrt(weights)[:, None]
        fitted = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
        normal = fitted if fitted @ normal > 0 else -fitted
        height = float(middle @ normal)
    return normal, height


def _measure_floor(
    points: NDArray[np.float64], normal: NDArray[np.float64], height: float, thick: float
) -> Floor:
    layers = (points @ normal - height) / thick
    within = (np.abs(layers) <= 1).mean()
    above = ((layers > 2) & (layers <= 6)).mean() / 2  # four thicknesses, so half for two
    below = (layers < -3).mean()
    return Floor(normal, height, float(within), float(below),
                 float(min(within / max(above, 1e-9), 99.0)))


def _width(points: NDArray[np.float64], floor: Floor, thick: float) -> float:
    """Returns the standard deviation of a floor's points along its narrow side."""
    inside = points[np.abs(points @ floor.up - floor.height) <= thick]
    if len(inside) < 3:
        return 0.0
    offsets = inside - inside.mean(axis=0)
    return float(np.sqrt(max(np.linalg.eigvalsh(offsets.T @ offsets / len(inside))[1], 0.0)))


def _peakiness(flat: NDArray[np.float64], degrees: float, thick: float) -> float:
    """Returns the sum of the squared counts in layers along a heading and across it."""
    angle = np.radians(degrees)
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    total = 0.0
    for heights in axes @ flat.T:
        counts = np.bincount(((heights - heights.min()) / thick).astype(np.int64))
        total += float((counts.astype(np.float64) ** 2).sum())
    return total
