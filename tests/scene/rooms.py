"""A furnished room as a cloud of points, and a hand-held camera that walks through it: known truth.

The room's own frame has z up and the floor at 0, in metres. What is handed out lies in a frame that
is turned, shifted and scaled against it, as a mapper's is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from test_similarity import random_rotation

from recon_cli.scene.similarity import Similarity

NOISE = 0.015  # metres; points on the floor of the rendered rooms scatter by 1 to 2 cm


@dataclass(frozen=True, eq=False)
class Room:
    """Points and cameras in the mapper's frame, and where that lies.

    Attributes:
        points: [P, 3].
        viewmats: [C, 4, 4] world to camera.
        truth: from the mapper's frame to the room's.
    """

    points: NDArray[np.float64]
    viewmats: NDArray[np.float64]
    truth: Similarity

    @property
    def up(self) -> NDArray[np.float64]:
        """[3] unit vector in the mapper's frame."""
        return self.truth.rotation[2]

    def named(self) -> dict[str, NDArray[np.float64]]:
        """The cameras by the name of their frame."""
        return {f"{i:06d}.png": viewmat for i, viewmat in enumerate(self.viewmats)}


def make_room(
    *, seed: int = 0, roll_deg: float = 1.0, roll_bias_deg: float = 0.0, cameras: int = 60,
    turn_deg: float = 360.0, floor: bool = True, walls: bool = True,
) -> Room:
    """Returns a room of 5 x 4 x 2.5 m.

    Args:
        seed: of noise, furniture and the frame.
        roll_deg: standard deviation of the cameras' roll.
        roll_bias_deg: mean roll.
        cameras: how many.
        turn_deg: how far they turn altogether.
        floor: whether there are points on the floor.
        walls: whether there are points on the walls.
    """
    rng = np.random.default_rng(seed)
    parts = [rng.uniform([0.5, 0.5, 0.1], [4.5, 3.5, 2.0], (1500, 3))]  # clutter
    if floor:
        parts.append(rng.uniform([0, 0, 0], [5, 4, 0], (1000, 3)))
    if walls:
        for low, high in (([0, 0, 0], [5, 0, 2.5]), ([0, 4, 0], [5, 4, 2.5]),
                          ([0, 0, 0], [0, 4, 2.5]), ([5, 0, 0], [5, 4, 2.5])):
            parts.append(rng.uniform(low, high, (400, 3)))
    points = np.concatenate(parts)
    points += rng.normal(0, NOISE, points.shape)
    turns = np.radians(np.linspace(0, turn_deg, cameras, endpoint=False))
    rolls = np.radians(rng.normal(roll_bias_deg, roll_deg, cameras))
    pitches = np.radians(rng.normal(-12, 8, cameras))
    places = np.stack([
        2.5 + 1.2 * np.cos(turns), 2 + 0.8 * np.sin(turns), rng.normal(1.45, 0.08, cameras)], 1)
    viewmats = np.stack([
        looking(*angles) for angles in zip(turns, pitches, rolls, strict=True)])
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], places)
    truth = Similarity(rng.uniform(0.2, 0.5), random_rotation(rng), rng.normal(size=3))
    back = truth.inverse()
    return Room(back.points(points), np.stack([back.viewmat(one) for one in viewmats]), truth)


def looking(turn: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Returns the viewmat [4, 4] of a camera at the origin; angles in radians, z up."""
    forward = np.array([
        np.cos(turn) * np.cos(pitch), np.sin(turn) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(turn), -np.cos(turn), 0])
    return rolled(np.stack([right, np.cross(forward, right), forward]), roll)


def rolled(rotation: NDArray[np.float64], roll: float) -> NDArray[np.float64]:
    """Returns a viewmat [4, 4] whose camera is turned about its own axis by `roll` radians."""
    viewmat = np.eye(4)
    cos, sin = np.cos(roll), np.sin(roll)
    viewmat[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ rotation[:3, :3]
    return viewmat


def degrees_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """The angle between two unit vectors."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
