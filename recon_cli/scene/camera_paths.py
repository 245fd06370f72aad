"""Camera paths: along the cameras of a capture, through keyframes, a tour, and an orbit.

Except through keyframes, the camera centres are the control points of a cubic B-spline. It stays
within their convex hull, so the path inside a room leaves through no wall, but cuts corners and
misses the centres themselves.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.statistics import FINE_SAMPLE

_MIDDLE = 0.5  # of the picture's sides: the part that shows a camera's target
_LEAST_RADIUS = 0.05  # of the median distance from the middle: cameras may all be above it
# Standard deviation of the filter before the spline: a fortieth of the path, up to three cameras.
# With the spline it reduces the radius of a circle of 24 cameras by 2.5%, of 96 cameras by 1.4%.
_SHARE, _MOST = 1 / 40, 3.0
_MEAN_MIN = 0.5  # length of a mean quaternion, below which rotations are too far apart to have one
_FINE = 64  # steps from camera to camera along which lengths are measured
_FASTER = 2.0  # times the mean turn rate of the view, above which the path slows down
# A tour is calmer than the hand that filmed, and nobody feels hurried or sick in it.
_CALM = 2.0  # times the filter of a path
_TURN = np.radians(15.0)  # a second, on average
_WALK = 0.2  # of the distance to what is seen, a second, on average
_SECONDS = (20.0, 180.0)  # shortest and longest
# Photos in no order: another order makes their path shorter than this share of the one by name.
_SHORTER = 0.6


def smooth_path(
    viewmats: NDArray[np.float64], count: int, *, calm: float = 1.0
) -> NDArray[np.float64]:
    """Returns `count` cameras [count, 4, 4] along a smooth path through cameras, at constant speed.

    Where the view would turn faster than twice its mean rate, the path slows down. `viewmats` [C,
    4, 4] are world to camera, OpenCV axes, in the order of the path; its ends are kept. `calm`
    widens the filter.
    """
    rotations, centers = _poses(viewmats)
    curve, last = _fit_spline(centers, rotations, calm)
    fine = np.linspace(0, last, int(_FINE * last) + 1)
    length = _path_length(*_split(curve(fine)))
    at = np.interp(np.linspace(0, length[-1], count), length, fine)
    return _viewmats(*_split(curve(at)))


def keyframe_path(
    viewmats: NDArray[np.float64], fovs: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns `count` cameras [count, 4, 4] and fields of view [count] smoothly through keyframes.

    `viewmats` [C, 4, 4], two or more that differ, and `fovs` [C] are passed exactly, by a
    Catmull-Rom spline with centripetal parameters (Yuksel et al. 2011), which neither loops nor
    overshoots far. The speed is constant, as that of `smooth_path`.
    """
    rotations, centers = _poses(viewmats)
    quats = _align_signs(Rotation.from_matrix(rotations).as_quat())
    length = np.diff(_path_length(centers, Rotation.from_quat(quats)))
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(np.maximum(length, 1e-12)))])
    points = np.concatenate([centers, quats, fovs[:, None]], axis=1)
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    tangents = np.concatenate([
        slopes[:1], (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1]),
        slopes[-1:]])
    curve = CubicHermiteSpline(knots, points, tangents)
    parts = [np.linspace(a, b, _FINE, endpoint=False) for a, b in itertools.pairwise(knots)]
    fine = np.concatenate([*parts, knots[-1:]])
    length = _path_length(*_split(curve(fine)[:, :7]))
    found = curve(np.interp(np.linspace(0, length[-1], count), length, fine))
    return _viewmats(*_split(found[:, :7])), found[:, 7]


def tour_path(viewmats: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Returns `count` cameras [count, 4, 4] of a quiet tour along the path of a capture.

    Cameras of photos that were taken in no order are put into one first.
    """
    return smooth_path(viewmats[order_cameras(viewmats)], count, calm=_CALM)


def tour_seconds(path: NDArray[np.float64], distance: float) -> float:
    """Returns how long a tour along `path` [count, 4, 4] takes at an easy pace.

    `distance` is to what is seen, in world units.
    """
    rotations, centers = _poses(path)
    turns = Rotation.from_matrix(rotations)
    angle = float((turns[:-1].inv() * turns[1:]).magnitude().sum())
    way = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    seconds = max(angle / _TURN, way / (_WALK * max(distance, 1e-12)))
    return float(np.clip(seconds, *_SECONDS))


def order_cameras(viewmats: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the order [C] of a path through cameras [C, 4, 4]: the given one where it is short.

    The steps of another order are those to the nearest camera that is left, by its place and its
    direction of view.
    """
    rotations, centers = _poses(viewmats)
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0
    places = np.concatenate([centers / spread, rotations[:, :, 2]], axis=1)
    count = len(places)
    order, left = [0], np.ones(count, bool)
    left[0] = False
    for _ in range(count - 1):
        steps = np.where(left, np.linalg.norm(places - places[order[-1]], axis=1), np.inf)
        order.append(int(steps.argmin()))
        left[order[-1]] = False
    lengths = [float(np.linalg.norm(np.diff(places[way], axis=0), axis=1).sum())
               for way in (np.arange(count), order)]
    return np.array(order) if lengths[1] < _SHORTER * lengths[0] else np.arange(count)


def _poses(
    viewmats: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns camera-to-world rotations [C, 3, 3] and centres [C, 3]."""
    rotations = viewmats[:, :3, :3].transpose(0, 2, 1)
    return rotations, -np.einsum("cij,cj->ci", rotations, viewmats[:, :3, 3])


def _viewmats(centers: NDArray[np.float64], turns: Rotation) -> NDArray[np.float64]:
    """Returns world-to-camera matrices [C, 4, 4] of centres [C, 3] and camera-to-world turns."""
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    viewmats[:, :3, :3] = turns.as_matrix().transpose(0, 2, 1)
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], centers)
    return viewmats


def _fit_spline(
    centers: NDArray[np.float64],  # [C, 3]
    rotations: NDArray[np.float64],  # [C, 3, 3]
    calm: float,
) -> tuple[BSpline, float]:
    """Returns the curve of centres and quaternions, [7] each, and the parameter of its end."""
    sigma = calm * min(_SHARE * len(centers), _MOST)
    quats = _align_signs(Rotation.from_matrix(rotations).as_quat())
    mean = gaussian_filter1d(quats, sigma, axis=0, mode="nearest")
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    quats = _align_signs(np.where(length > _MEAN_MIN, mean / np.maximum(length, _MEAN_MIN), quats))
    centers = gaussian_filter1d(centers, sigma, axis=0, mode="nearest")
    controls = np.concatenate([centers, quats], axis=1)
    degree = min(3, len(controls) - 1)
    last = float(max(1, len(controls) - degree))
    knots = np.concatenate([
        np.zeros(degree), np.linspace(0, last, len(controls) - degree + 1), np.full(degree, last)])
    return BSpline(knots, controls, degree), last


def _align_signs(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the same rotations [C, 4] with the signs that bring neighbours closest."""
    flipped = np.einsum("ci,ci->c", quats[1:], quats[:-1]) < 0
    return quats * np.cumprod(np.concatenate([[1.0], np.where(flipped, -1.0, 1.0)]))[:, None]


def _split(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], Rotation]:
    return points[:, :3], Rotation.from_quat(points[:, 3:])  # of any length


def _path_length(centers: NDArray[np.float64], rotations: Rotation) -> NDArray[np.float64]:
    """Returns the length of the path up to each point, in units that take equal time."""
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    angles = (rotations[:-1].inv() * rotations[1:]).magnitude()
    shares = np.maximum(_shares(steps), _shares(angles) / _FASTER)
    if not shares.any():  # all cameras are the same
        shares = np.ones_like(shares)
    return np.concatenate([[0.0], np.cumsum(shares)])


def _shares(parts: NDArray[np.float64]) -> NDArray[np.float64]:
    total = parts.sum()
    return np.asarray(parts / total if total > 1e-12 else np.zeros_like(parts))


def orbit_path(
    centers: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Returns `count` cameras [count, 4, 4] on a circle around a point, all of them looking at it.

    The circle has the median horizontal distance and height of `centers` [C, 3], starts on the side
    of the first and turns anticlockwise as seen from above; `up` is a unit vector. It is closed:
    one more camera would be the first again.
    """
    offsets = centers - target
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    distances = np.linalg.norm(flat, axis=1)
    radius = max(np.median(distances), _LEAST_RADIUS * np.median(np.linalg.norm(offsets, axis=1)),
                 np.finfo(float).tiny ** 0.25)
    start = flat[0] / distances[0] if distances[0] > 1e-6 * radius else _horizontal(up)
    across = np.cross(up, start)
    angles = 2 * np.pi * np.arange(count)[:, None] / count
    eyes = target + np.median(heights) * up + radius * (
        np.cos(angles) * start + np.sin(angles) * across)
    return np.stack([looking_at(eye, target, up) for eye in eyes])


def _horizontal(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a unit vector perpendicular to `up`."""
    vector = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return np.asarray(vector / np.linalg.norm(vector))


def find_look_at(cameras: list[Camera], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the point [3] that cameras look at, by the points in the middle of their pictures.

    Each camera looks at the point on its axis at the median depth of those points [P, 3]; the
    result is the median of these, coordinate by coordinate.
    """
    places = []
    for camera in cameras:
        depths = visible_depths(camera, points, _MIDDLE)
        if len(depths):
            places.append(camera.center + np.median(depths) * camera.viewmat[2, :3])
    return np.asarray(np.median(places or points, axis=0))


def visible_depths(
    camera: Camera, points: NDArray[np.float64], part: float = 1.0
) -> NDArray[np.float64]:
    """Returns the depths of the points within the middle `part` of a picture's sides."""
    sample = points[:: max(1, len(points) // FINE_SAMPLE)]
    pixels, depths = camera.project(sample)
    off = np.abs(pixels - (camera.cx, camera.cy))
    return depths[(off < (part * camera.width / 2, part * camera.height / 2)).all(axis=1)]
