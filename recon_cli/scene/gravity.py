"""Where up is, from how the cameras are held and from the floor below them.

A hand pitches and turns a phone freely but keeps its horizon level: up is the direction at right
angles to the x axes of the cameras, and the y axes say which end of it is up. A floor near that in
the points is the better witness. Where the two do not agree, or the cameras say nothing, nothing is
said: a scene that leans is worse than one that was left as it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import format_count
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.statistics import robust_sigma
from recon_cli.scene.surfaces import Floor, Walls, find_floor, find_walls

# Cameras that turn all around have no mean direction: below this length it is that of the noise.
_MEAN_MIN = 0.1


@dataclass(frozen=True, eq=False)
class Axes:
    """A frame for a scene whose up is known."""

    similarity: Similarity  # from the scene's coordinates to that frame; its scale is 1
    walls: Walls  # what gave the x axis where `walls.found`, else the cameras' mean right did


def turn_onto(
    one: NDArray[np.float64],  # [3]
    other: NDArray[np.float64],  # [3]
) -> NDArray[np.float64]:
    """Returns the smallest rotation [3, 3] from one unit vector to another (Rodrigues)."""
    cosine = float(one @ other)
    if cosine < -1 + 1e-9:  # half a turn about the axis of coordinates most at right angles
        axis = np.zeros(3)
        axis[np.argmin(np.abs(one))] = 1
        axis -= (axis @ one) * one
        axis /= np.linalg.norm(axis)
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3))
    x, y, z = np.cross(one, other)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


def upright_axes(
    gravity: Gravity, points: NDArray[np.float64], viewmats: NDArray[np.float64]
) -> Axes:
    """Returns the frame with z up and its origin below the middle of the cameras.

    z is 0 on the floor; where there is none, at the mean height of the cameras. x is the one of the
    four directions along and across the walls that is nearest to the cameras' mean right.
    `gravity.up` must be known; `points` are [P, 3], `viewmats` [C, 4, 4] world to camera.
    """
    assert gravity.up is not None, "the frame of a scene whose up is not known"
    up = gravity.up
    right = _flat(viewmats[:, 0, :3].mean(axis=0), up)
    if np.linalg.norm(right) < _MEAN_MIN:
        right = _flat(viewmats[0, 0, :3], up)
    walls = find_walls(points, up)
    if walls.found:
        across = np.cross(up, walls.along)
        right = max((walls.along, across, -walls.along, -across), key=lambda one: one @ right)
    x = right / np.linalg.norm(right)
    rotation = np.stack([x, np.cross(up, x), up])
    centers = -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])
    origin = rotation @ centers.mean(axis=0)
    if gravity.floor:
        origin[2] = gravity.floor.height
    return Axes(Similarity(1.0, rotation, -origin), walls)


def _flat(direction: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the horizontal part of a direction."""
    return np.asarray(direction - (direction @ up) * up)


MIN_CAMERAS = 3
# Between up by single frames of a device and its mean, in the median, and up by two of its sensors.
MAX_UP_SPREAD_DEG = 5.0
# Frames whose rolls count as independent: a hand leans for many frames. The errors of two rendered
# walks of 75 frames were those of 2.5 independent frames.
_INDEPENDENT = 5
# Standard error up to which the cameras are believed without a floor, and up to which they are good
# enough to look for one. Measured: 0.4 degrees in rendered walks, 1.1 along a desk (then upright),
# 2.8 around a toy on a bed (then leaning by about five), 6.6 in a half circle with rolls of 4.5.
_MAX_ALONE_DEG = 2.0
# Where the cameras turn by less, a common roll passes for a slope: twelve frames that turn by 10.7
# degrees, rolled by 2, said an error of 1.9 degrees and were off by 5.2.
_MIN_SPREAD_ALONE_DEG = 12.0
_MAX_WITH_FLOOR_DEG = 10.0
_MIN_UPRIGHT = 0.7  # share; a phone turned over halfway does not show which end is up
_CONE_DEG = (6.0, 15.0)  # least and greatest; in between three standard errors
_STEPS = 50  # of the reweighting; it converges in about ten
_FLOOR_WEIGHT = np.radians(0.5)  # rolls below this count alike: no single frame decides


@dataclass(frozen=True, eq=False)
class CameraUp:
    """Up as estimated from the axes of the cameras."""

    up: NDArray[np.float64]  # [3] unit vector
    roll_deg: float  # median angle between a camera's x axis and the horizontal plane
    # how far the x axes turn within that plane, as a standard deviation across their main
    # direction; at most 45. Where it is small, up is free to turn about that direction
    spread_deg: float
    error_deg: float  # standard error of `up`, from both
    upright: float  # share of the cameras whose image is not upside down
    sideways: bool  # the y axes would be the better witness, as if the phone were held on its side


@dataclass(frozen=True, eq=False)
class Gravity:
    """Whether it is known where up is."""

    up: NDArray[np.float64] | None  # [3] unit vector, or None
    floor: Floor | None  # the floor at right angles to it, or None
    cameras: CameraUp | None  # estimated from the cameras' axes; None where there are too few
    reason: str = ""  # why it is not known, for people; empty where it is


def find_gravity(points: NDArray[np.float64], viewmats: NDArray[np.float64]) -> Gravity:
    """Returns where up is by points [P, 3] and `viewmats` [C, 4, 4] world to camera."""
    if len(viewmats) < MIN_CAMERAS:
        return Gravity(None, None, None, f"there are only {format_count(len(viewmats), 'camera')}")
    measured = camera_up(viewmats)
    doubt = _doubt(measured)
    if doubt:
        return Gravity(None, None, measured, doubt)
    centers = -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])
    cone = float(np.clip(3 * measured.error_deg, *_CONE_DEG))
    floor = find_floor(points, centers, measured.up, cone_deg=cone)
    if floor:
        return Gravity(floor.up, floor, measured)
    if find_floor(points, centers, -measured.up, cone_deg=cone):
        return Gravity(
            None, None, measured, "the only large level surface lies above the cameras: either it "
            "is a ceiling, or the images are upside down")
    if measured.error_deg > _MAX_ALONE_DEG or measured.spread_deg < _MIN_SPREAD_ALONE_DEG:
        return Gravity(None, None, measured, f"{_loose(measured)}, and the points show no floor")
    return Gravity(measured.up, None, measured)


def _doubt(measured: CameraUp) -> str:
    """Returns why the cameras do not show up; empty where they do."""
    if measured.sideways:
        return "the images seem to lie on their side"
    if measured.error_deg > _MAX_WITH_FLOOR_DEG:
        return _loose(measured)
    if measured.upright < _MIN_UPRIGHT:
        return f"{1 - measured.upright:.0%} of the images are upside down against the others"
    return ""


def _loose(measured: CameraUp) -> str:
    return (
        f"the cameras roll by {measured.roll_deg:.1f} degrees and turn by "
        f"{measured.spread_deg:.0f}, which leaves up uncertain by {measured.error_deg:.0f} degrees")


def camera_up(viewmats: NDArray[np.float64]) -> CameraUp:
    """Estimates up from the axes of three or more cameras [C, 4, 4] (world to camera)."""
    right, down = viewmats[:, 0, :3], viewmats[:, 1, :3]
    up, spread, error = _normal(right)
    upright = float((down @ up < 0).mean())
    if upright < 0.5:
        up, upright = -up, 1 - upright
    roll = np.median(np.abs(np.arcsin(np.clip(right @ up, -1, 1))))
    return CameraUp(
        up, float(np.degrees(roll)), float(np.degrees(np.arcsin(spread))),
        float(np.degrees(error)), upright, _normal(down)[2] < error)


def mean_up(viewmats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the unit vector [3] that is up for cameras [C, 4, 4]; for one or two, the first's."""
    return camera_up(viewmats).up if len(viewmats) >= MIN_CAMERAS else -viewmats[0, 1, :3]


def _normal(axes: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
    """Returns the normal [3] of most `axes` [C, 3], their RMS across it, and its error in rad.

    Reweighted least squares towards the sum of absolute deviations, so that frames in which the
    camera leans do not pull. The RMS is along the second direction, 0 to 0.71.
    """
    weights = np.ones(len(axes))
    for _ in range(_STEPS):
        values, vectors = np.linalg.eigh((axes * weights[:, None]).T @ axes / weights.sum())
        weights = 1 / np.maximum(np.abs(axes @ vectors[:, 0]), _FLOOR_WEIGHT)
    spread = float(np.sqrt(max(values[1], 0.0)))
    off = robust_sigma(np.arcsin(np.clip(axes @ vectors[:, 0], -1, 1)))
    error = off / max(spread * np.sqrt(_INDEPENDENT), 1e-12)
    return vectors[:, 0], spread, float(min(error, np.pi / 2))
