"""A circle around what the cameras look at, level with the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
