"""A world frame that people expect: z up, the floor at 0, x along a wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.gravity import Gravity
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.surfaces import Walls, find_walls

# Cameras that turn all around have no mean direction: below this length it is that of the noise.
_MEAN_MIN = 0.1


@dataclass(frozen=True, eq=False)
class Axes:
    """A frame for a scene whose up is known.

    Attributes:
        similarity: from the scene's coordinates to that frame; its scale is 1.
        walls: what gave the x axis where `walls.found`, else the cameras' mean right did.
    """

    similarity: Similarity
    walls: Walls


def turn_onto(
    one: NDArray[np.float64],  # [3]
    other: NDArray[np.float64],  # [3]
) -> NDArray[np.float64]:
    """Returns the smallest rotation [3, 3] that takes one unit vector to another.

    Rodrigues' formula. Between opposite vectors it is the half turn about the axis of coordinates
    that is most at right angles to them, so that x stays where it is for y and z.
    """
    cosine = float(one @ other)
    if cosine < -1 + 1e-9:
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

    Args:
        gravity: with `up` known.
        points: [P, 3] sparse points.
        viewmats: [C, 4, 4] world to camera.
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
