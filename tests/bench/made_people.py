"""People who walk through photos, drawn into views with known depth.

The ellipsoids of a person are met by the ray of each pixel. The nearer of solid and room is seen,
and on the floor lies a shadow. World z is up and the floor at 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.stereo.depths import unproject

Array = NDArray[np.float64]
_LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])
_STEP = 0.75  # metres of a whole stride, over 2 pi
_SHADOW = 0.45  # of the light that is taken away in its middle


@dataclass(frozen=True, eq=False)
class Solid:
    """An ellipsoid: |x / half| <= 1 in the axes of `turn`."""

    middle: Array  # [3]
    half: Array  # [3] half lengths
    turn: Array  # [3, 3] rotation, own axes in columns
    color: Array  # [3] 0 to 1
    stripes: float = 0.0  # of them per unit of height


@dataclass(frozen=True, eq=False)
class Thing:
    """Solids that stand on the floor, and where."""

    solids: tuple[Solid, ...]
    foot: Array  # [2] on the floor
    reach: float  # radius of its shadow


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def person(foot: Array, heading: float, walked: float, height: float = 1.7) -> Thing:
    """Returns a person of a height who looks along `heading` after having walked so far."""
    turn, unit = _about_z(heading), height / 1.7
    swing = 0.2 * np.sin(walked / (unit * _STEP) * 2 * np.pi)
    shirt, trousers, skin, hair = (np.array(color) for color in (
        (0.75, 0.18, 0.15), (0.13, 0.16, 0.3), (0.82, 0.62, 0.5), (0.15, 0.1, 0.07)))
    parts = [  # forward, left, up; half lengths; colour; stripes
        ((0, 0, 1.57), (0.1, 0.085, 0.13), skin, 0),
        ((-0.02, 0, 1.62), (0.105, 0.09, 0.11), hair, 0),
        ((0, 0, 1.18), (0.13, 0.22, 0.34), shirt, 14),
        ((0, 0, 0.9), (0.12, 0.18, 0.16), trousers, 0),
        ((swing, 0.1, 0.45), (0.09, 0.085, 0.47), trousers, 0),
        ((-swing, -0.1, 0.45), (0.09, 0.085, 0.47), trousers, 0),
        ((-swing, 0.26, 1.15), (0.06, 0.055, 0.32), shirt, 14),
        ((swing, -0.26, 1.15), (0.06, 0.055, 0.32), shirt, 14)]
    at = np.array([*foot, 0.0])
    return Thing(tuple(
        Solid(at + turn @ (unit * np.array(middle)), unit * np.array(half), turn, color,
              stripes / unit) for middle, half, color, stripes in parts),
        np.asarray(foot), 0.3 * unit)


def draw(
    photo: NDArray[np.uint8], depth: NDArray[np.float32], camera: Camera, things: Sequence[Thing]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns a photo [H, W, 3] with things in it, and where they and where their shadows are."""
    height, width = depth.shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy,
                     np.ones_like(columns)], axis=-1).reshape(-1, 3) @ camera.viewmat[:3, :3]
    nearest = np.where(depth > 0, depth, np.inf).reshape(-1).astype(np.float64)
    image = photo.reshape(-1, 3).astype(np.float64) / 255
    shaded = _shadow(image, depth, camera, things)
    drawn = np.zeros(len(image), np.bool_)
    for solid in (solid for thing in things for solid in thing.solids):
        distance, normal = _meet(solid, camera.center, rays)
        hit = distance < nearest
        nearest[hit] = distance[hit]
        where = camera.center + rays[hit] * distance[hit, None]
        light = 0.5 + 0.5 * np.clip(normal[hit] @ _LIGHT, 0, 1)
        if solid.stripes:
            light *= np.where(np.sin(2 * np.pi * solid.stripes * where[:, 2]) > 0, 1.0, 0.65)
        image[hit] = solid.color * light[:, None]
        drawn |= hit
    result = np.rint(image.clip(0, 1) * 255).astype(np.uint8).reshape(photo.shape)
    return result, drawn.reshape(depth.shape), (shaded & ~drawn).reshape(depth.shape)


def _shadow(
    image: Array, depth: NDArray[np.float32], camera: Camera, things: Sequence[Thing]
) -> NDArray[np.bool_]:
    """Darkens the floor about the feet and returns where that shows."""
    pixels = np.arange(depth.size)
    where = unproject(camera, depth, pixels)
    shaded = np.zeros(depth.size, np.bool_)
    for thing in things:
        low = (np.abs(where[:, 2]) < 0.4 * thing.reach) & (depth.reshape(-1) > 0)
        away = where[:, :2] - thing.foot + 0.6 * thing.reach * _LIGHT[:2]
        taken = _SHADOW * np.exp(-0.5 * (away**2).sum(axis=1) / thing.reach**2) * low
        image *= 1 - taken[:, None]
        shaded |= taken > 0.1
    return shaded


def _meet(solid: Solid, eye: Array, rays: Array) -> tuple[Array, Array]:
    """Returns the depth [N] at which rays meet a solid, infinite for none, and normals [N, 3]."""
    start = (eye - solid.middle) @ solid.turn / solid.half
    along = rays @ solid.turn / solid.half
    a, b, c = (along**2).sum(1), along @ start, start @ start - 1
    root = b * b - a * c
    distance = (-b - np.sqrt(np.maximum(root, 0))) / a
    met = (root > 0) & (distance > 0)
    own = start + along * distance[:, None]
    normal = (own / solid.half) @ solid.turn.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.where(met, distance, np.inf), normal


def cross_view(
    first: Camera, last: Camera, steps: int, distance: float, bearing: float = 0.45
) -> list[tuple[Array, float, float]]:
    """Returns foot, heading and way of a person who walks straight across two cameras' views.

    From the left of the first to the right of the last, `bearing` rad from the middle, so far away.
    """
    ends = []
    for camera, side in ((first, bearing), (last, -bearing)):
        ahead = camera.viewmat[2, :2] / np.linalg.norm(camera.viewmat[2, :2])
        ends.append(camera.center[:2] + distance * _about_z(side)[:2, :2] @ ahead)
    way = ends[1] - ends[0]
    heading = float(np.arctan2(way[1], way[0]))
    return [(ends[0] + share * way, heading, float(share * np.linalg.norm(way)))
            for share in np.linspace(0, 1, steps)]
