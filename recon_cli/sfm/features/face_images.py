"""Panoramas resampled to the faces of a cube; see `scene.faces`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.faces import (
    CUBE,
    Face,
    face_camera,
    face_size,
    nearest_face,
    panorama_pixels,
    pixel_rays,
)

# Of pictures to train on: frames resampled to phone frames in the same place come .4 dB nearer to
# them than by bilinear pixels, as faces as fine as the panorama (office; living .1); faces twice as
# fine come no nearer.
PICTURES = cv2.INTER_CUBIC
_AROUND = 2  # pixels that a bicubic pixel reaches


@dataclass(frozen=True, eq=False)
class FaceWarp:
    """Where the pixels of a face lie in its panorama."""

    side: int  # pixels
    focal: float  # pixels
    # [side, side, 2] float32, for OpenCV: 0, 0 is the middle of the first pixel
    places: NDArray[np.float32]
    own: NDArray[np.uint8]  # [side, side], 1 where no other face is nearer, else 0

    def camera(self, face: Face, viewmat: NDArray[np.float64]) -> Camera:
        """Returns the camera of the face of a panorama [4, 4], world to camera."""
        return face_camera(face, self.side, self.focal, viewmat)


@cache
def cube_warps(width: int, height: int) -> tuple[tuple[Face, FaceWarp], ...]:
    """Returns the faces of panoramas of a size, and where their pixels lie."""
    side, focal = face_size(width / (2 * np.pi))
    rotations = [face.rotation for face in CUBE]
    warps = []
    for place, face in enumerate(CUBE):
        rays = pixel_rays(face_camera(face, side, focal, np.eye(4))) @ face.rotation
        places = (panorama_pixels(rays, width, height) - 0.5).astype(np.float32)
        warps.append((face, FaceWarp(
            side, focal, places, (nearest_face(rays, rotations) == place).astype(np.uint8))))
    return tuple(warps)


def cut_face(
    image: NDArray[np.uint8], warp: FaceWarp, interpolation: int = cv2.INTER_LINEAR
) -> NDArray[np.uint8]:
    """Returns a face of a panorama [H, W] or [H, W, C], interpolated across its seam."""
    return np.asarray(cv2.remap(
        _wrapped(image), warp.places + _AROUND, None, interpolation,
        borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _wrapped(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns a panorama with some pixels more around it: its other edge, and beyond a pole half a
    turn on."""
    half = image.shape[1] // 2
    rows = np.concatenate([
        np.roll(image[_AROUND - 1::-1], half, axis=1), image,
        np.roll(image[:-_AROUND - 1:-1], half, axis=1)])
    return np.concatenate([rows[:, -_AROUND:], rows, rows[:, :_AROUND]], axis=1)
