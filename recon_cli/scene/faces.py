"""Faces: pinhole views into a picture that sees more than one pinhole camera can.

A panorama becomes the six faces of a cube around its camera. Each face sees a little more than a
quarter turn, so that what is measured in a window of pixels is whole up to where the next begins.
The picture of a wide lens becomes a grid of faces that lie around its axis.

Axes are OpenCV's. A panorama is equirectangular as COLMAP has it: its middle looks along z, x is to
the right, and the middle of the first pixel lies at 0.5, 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera

# Of a face; the pixels beyond a quarter turn are twice what the window of SSIM reaches.
FIELD_DEG = 95.0
LEAST_SIDE = 32  # pixels of a face


@dataclass(frozen=True, eq=False)
class Face:
    """A direction to look into."""

    name: str  # part of the name of its view
    rotation: NDArray[np.float64]  # [3, 3] from the axes of the picture to those of the face


def _turn(yaw_deg: float, pitch_deg: float) -> NDArray[np.float64]:
    """Returns [3, 3] from a picture's axes to a camera's turned right and then up by angles."""
    return np.asarray(np.rint(_tilt(yaw_deg, pitch_deg)))  # quarter turns are exact


def _tilt(yaw_deg: float, pitch_deg: float) -> NDArray[np.float64]:
    """Does as `_turn` for any angles."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    (s, c), (t, d) = (np.sin(yaw), np.cos(yaw)), (np.sin(pitch), np.cos(pitch))
    level = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return np.asarray(np.array([[1, 0, 0], [0, d, t], [0, -t, d]]) @ level)


CUBE: tuple[Face, ...] = tuple(Face(name, _turn(yaw, pitch)) for name, yaw, pitch in (
    ("front", 0, 0), ("right", 90, 0), ("back", 180, 0), ("left", -90, 0),
    ("up", 0, 90), ("down", 0, -90)))


def grid_faces(
    across_deg: tuple[float, float], upward_deg: tuple[float, float],  # from and to, of all rays
    columns: int, rows: int,
) -> tuple[Face, ...]:
    """Returns faces that share out the field of a wide lens evenly, by rows from the upper left."""
    def middles(span: tuple[float, float], count: int) -> list[float]:
        step = (span[1] - span[0]) / count
        return [span[0] + (place + 0.5) * step for place in range(count)]

    turns = [(yaw, pitch) for pitch in reversed(middles(upward_deg, rows))
             for yaw in middles(across_deg, columns)]
    return tuple(Face(f"view{number}", _tilt(yaw, pitch))
                 for number, (yaw, pitch) in enumerate(turns, 1))


def is_cube_face(view: str) -> bool:
    """Returns whether the view of a name is a face of a cube."""
    return face_order(view) < len(CUBE)


def middle_axes(
    rotations: Sequence[NDArray[np.float64]],  # [3, 3] each, from the world to a face
) -> NDArray[np.float64]:  # [3, 3]
    """Returns the rotation in the middle of those of the faces of a wide lens."""
    left, _, right = np.linalg.svd(np.sum(rotations, axis=0))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return np.asarray(left @ turn @ right)


def view_name(frame: str, face: Face) -> str:
    """Returns the file name of the view of a face, from that of its frame."""
    path = PurePath(frame)
    return f"{path.stem}_{face.name}{path.suffix}"


def face_order(view: str) -> int:
    """Returns the place of a face of a cube by the name of its view; behind all for other names."""
    stem = PurePath(view).stem
    return next((place for place, face in enumerate(CUBE) if stem.endswith(f"_{face.name}")),
                len(CUBE))


def face_size(radian_px: float, field_deg: float = FIELD_DEG) -> tuple[int, float]:
    """Returns (side, focal length) in pixels of a face, for the pixels of a radian of the picture.

    The middle of the face is as fine as the picture; its side is even.
    """
    side = max(LEAST_SIDE, 2 * round(radian_px * math.tan(math.radians(field_deg / 2))))
    return side, side / 2 / math.tan(math.radians(field_deg / 2))


def face_camera(
    face: Face, side: int, focal: float,
    viewmat: NDArray[np.float64],  # [4, 4] world to the camera of the picture
) -> Camera:
    """Returns the camera of a face."""
    turned = np.eye(4)
    turned[:3, :3] = face.rotation
    return Camera(side, side, focal, focal, side / 2, side / 2, turned @ viewmat)


def pixel_rays(camera: Camera) -> NDArray[np.float64]:  # [H, W, 3]
    """Returns the rays through the middles of all pixels, of depth 1, in the axes of the camera."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    across, down = np.meshgrid(x, y)
    return np.stack([across, down, np.ones_like(across)], axis=2)


def panorama_pixels(
    rays: NDArray[np.float64],  # [..., 3] of any length
    width: int, height: int,
) -> NDArray[np.float64]:  # [..., 2]
    """Returns where directions lie in a panorama, in pixels."""
    x, y, z = np.moveaxis(rays, -1, 0)
    longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    return np.stack([(longitude / (2 * np.pi) + 0.5) * width,
                     (0.5 - latitude / np.pi) * height], axis=-1)


def panorama_rays(width: int, height: int) -> NDArray[np.float64]:  # [height, width, 3]
    """Returns the unit vectors along which the middles of the pixels of a panorama look."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    return np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude),
                     np.cos(latitude) * np.cos(longitude)], axis=2)


def nearest_face(
    rays: NDArray[np.float64],  # [..., 3]
    rotations: Sequence[NDArray[np.float64]],  # [3, 3] each, from the axes of the rays
) -> NDArray[np.int64]:  # [...]
    """Returns the place of the face whose axis is nearest to each ray; the first of equal ones."""
    axes = np.stack([rotation[2] for rotation in rotations])
    # equal but for rounding: on the border of two faces
    return np.asarray(np.argmax(np.round(rays @ axes.T, 12), axis=-1))


def solid_angles(camera: Camera) -> NDArray[np.float64]:  # [H, W]
    """Returns the solid angle of each pixel, steradian (its middle's, which is exact enough)."""
    rays = pixel_rays(camera)
    return np.asarray((rays**2).sum(axis=2) ** -1.5 / (camera.fx * camera.fy))


def shared_out_angles(cameras: Sequence[Camera]) -> list[NDArray[np.float64]]:  # [H, W] each
    """Returns the solid angles of the pixels of the faces of one picture, each direction once.

    A direction belongs to the face whose axis is nearest; it weighs nothing in the others.
    """
    rotations = [camera.viewmat[:3, :3] for camera in cameras]
    return [np.where(
        nearest_face(pixel_rays(camera) @ camera.viewmat[:3, :3], rotations) == place,
        solid_angles(camera), 0.0) for place, camera in enumerate(cameras)]
