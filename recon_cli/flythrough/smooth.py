"""A smooth path through cameras that a hand held: the same walk, without the shake.

The centres are the control points of a cubic B-spline, which stays within their convex hull: from
a walk within a room the path cannot swing out through a wall. It rounds corners for that, and does
not pass through the centres themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from recon_cli.scene.camera import Camera, looking_at

_SAMPLES = 20_000  # points looked at
_MIDDLE = 0.5  # of the picture's sides: what a camera looks at lies in this part
_LEAST_RADIUS = 0.05  # of the median distance from the middle: cameras may all stand above it


def orbit_path(
    centers: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Returns `count` cameras once around a place, all of them looking at it.

    The circle has the median horizontal distance and the median height of `centers`, begins on the
    side of the first of them and turns anticlockwise as seen from above. It closes: one camera more
    would be the first again.

    Args:
        centers: [C, 3] of the cameras that give distance and height.
        target: [3] what is looked at.
        up: [3] unit vector.
        count: cameras to return, at least 1.

    Returns:
        [count, 4, 4] world to camera, OpenCV axes.
    """
    offsets = centers - target
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    distances = np.linalg.norm(flat, axis=1)
    radius = max(np.median(distances), _LEAST_RADIUS * np.median(np.linalg.norm(offsets, axis=1)),
                 np.finfo(float).tiny ** 0.25)
    start = flat[0] / distances[0] if distances[0] > 1e-6 * radius else _level(up)
    across = np.cross(up, start)
    angles = 2 * np.pi * np.arange(count)[:, None] / count
    eyes = target + np.median(heights) * up + radius * (
        np.cos(angles) * start + np.sin(angles) * across)
    return np.stack([looking_at(eye, target, up) for eye in eyes])


def _level(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns some unit vector at right angles to `up`."""
    level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return np.asarray(level / np.linalg.norm(level))


def middle_of_sight(
    cameras: list[Camera], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns [3] the middle of what cameras look at, by the points amid their pictures.

    Each camera looks at the place on its axis at the median depth of those points; of these places
    the median is taken, coordinate by coordinate.

    Args:
        cameras: at least one.
        points: [P, 3] of the scene, at least one.
    """
    places = []
    for camera in cameras:
        depths = depths_seen(camera, points, _MIDDLE)
        if len(depths):
            places.append(camera.center + np.median(depths) * camera.viewmat[2, :3])
    return np.asarray(np.median(places or points, axis=0))


def depths_seen(
    camera: Camera, points: NDArray[np.float64], part: float = 1.0
) -> NDArray[np.float64]:
    """Returns the depths of the points that lie in the middle `part` of a picture's sides."""
    few = points[:: max(1, len(points) // _SAMPLES)]
    seen = few @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    seen = seen[seen[:, 2] > 0]
    x = np.abs(seen[:, 0] / seen[:, 2] * camera.fx) < part * camera.width / 2
    y = np.abs(seen[:, 1] / seen[:, 2] * camera.fy) < part * camera.height / 2
    return np.asarray(seen[x & y, 2])


# Standard deviation of the filter before the spline: a fortieth of the path, up to three cameras.
# With the spline it takes 2.5% off the radius of a full circle of 24 cameras, 1.4% off one of 96.
_SHARE, _MOST = 1 / 40, 3.0
# Rotations whose mean is shorter than this as quaternions point too far apart to have one.
_MEAN_MIN = 0.5
_FINE = 64  # steps from camera to camera along which lengths are measured
_FASTER = 2.0  # than on average the view may turn before the walk slows down for it


def smooth_path(viewmats: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Returns `count` cameras along a smooth path through cameras, at constant speed.

    Where the view turns faster than twice its mean, the walk slows down so that it does not.

    Args:
        viewmats: [C, 4, 4] world to camera, OpenCV axes, in the order of the path; C at least 1.
        count: cameras to return, at least 1; the first and the last are the ends of the path.

    Returns:
        [count, 4, 4] world to camera.
    """
    turns = viewmats[:, :3, :3].transpose(0, 2, 1)
    centers = -np.einsum("cij,cj->ci", turns, viewmats[:, :3, 3])
    curve, last = _spline(centers, turns)
    fine = np.linspace(0, last, int(_FINE * last) + 1)
    way = _way(*_split(curve(fine)))
    at = np.interp(np.linspace(0, way[-1], count), way, fine)
    return _viewmats(*_split(curve(at)))


def _spline(
    centers: NDArray[np.float64],  # [C, 3]
    turns: NDArray[np.float64],  # [C, 3, 3]
) -> tuple[BSpline, float]:
    """Returns the curve of centres and quaternions, [7] each, and the parameter of its end."""
    sigma = min(_SHARE * len(centers), _MOST)
    quats = _continuous(Rotation.from_matrix(turns).as_quat())
    mean = gaussian_filter1d(quats, sigma, axis=0, mode="nearest")
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    quats = _continuous(np.where(length > _MEAN_MIN, mean / np.maximum(length, _MEAN_MIN), quats))
    centers = gaussian_filter1d(centers, sigma, axis=0, mode="nearest")
    controls = np.concatenate([centers, quats], axis=1)
    degree = min(3, len(controls) - 1)
    last = float(max(1, len(controls) - degree))
    knots = np.concatenate([
        np.zeros(degree), np.linspace(0, last, len(controls) - degree + 1), np.full(degree, last)])
    return BSpline(knots, controls, degree), last


def _continuous(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the same rotations [C, 4] with the signs by which neighbours are nearest."""
    turned = np.einsum("ci,ci->c", quats[1:], quats[:-1]) < 0
    return quats * np.cumprod(np.concatenate([[1.0], np.where(turned, -1.0, 1.0)]))[:, None]


def _split(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], Rotation]:
    return points[:, :3], Rotation.from_quat(points[:, 3:])  # of any length


def _way(centers: NDArray[np.float64], turns: Rotation) -> NDArray[np.float64]:
    """Returns how far along the path each point lies, in parts that take equal time."""
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    angles = (turns[:-1].inv() * turns[1:]).magnitude()
    shares = np.maximum(_shares(steps), _shares(angles) / _FASTER)
    if not shares.any():  # all cameras are one
        shares = np.ones_like(shares)
    return np.concatenate([[0.0], np.cumsum(shares)])


def _shares(parts: NDArray[np.float64]) -> NDArray[np.float64]:
    total = parts.sum()
    return np.asarray(parts / total if total > 1e-12 else np.zeros_like(parts))


def _viewmats(centers: NDArray[np.float64], turns: Rotation) -> NDArray[np.float64]:
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    viewmats[:, :3, :3] = turns.as_matrix().transpose(0, 2, 1)
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], centers)
    return viewmats
