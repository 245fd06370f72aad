"""Panoramas put together from pictures of faces: of a cube, or of a wide lens as a part of one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.faces import CUBE, face_order, middle_axes, nearest_face, panorama_rays


def stitch_faces(
    pictures: Sequence[NDArray[np.float32]],  # [H, W, C] each
    cameras: Sequence[Camera],  # of the pictures, all in one place
    axes: NDArray[np.float64],  # [3, 3] from the world to the axes of the panorama
    width: int, height: int,
) -> NDArray[np.float32]:  # [height, width, C]
    """Returns a panorama of which each pixel comes from the picture whose axis is nearest.

    It is black where that picture does not reach.
    """
    rays = panorama_rays(width, height) @ axes
    nearest = nearest_face(rays, [camera.viewmat[:3, :3] for camera in cameras])
    panorama = np.zeros((height, width, pictures[0].shape[2]), np.float32)
    for place, (picture, camera) in enumerate(zip(pictures, cameras, strict=True)):
        own = nearest == place
        local = rays[own] @ camera.viewmat[:3, :3].T
        pixels, _ = replace(camera, viewmat=np.eye(4)).project(local)
        ends = np.array((camera.width + 0.5, camera.height + 0.5))
        inside = np.all((pixels > -0.5) & (pixels < ends), axis=1, keepdims=True)
        places = np.nan_to_num(pixels)[:, None].astype(np.float32) - np.float32(0.5)
        panorama[own] = _sample(picture, places) * inside
    return panorama


def _sample(
    picture: NDArray[np.float32], places: NDArray[np.float32]  # [K, 1, 2]
) -> NDArray[np.float32]:  # [K, C]
    """Returns the values at places, interpolated; in portions, as OpenCV's sizes are 16 bits."""
    parts = [cv2.remap(picture, places[start:start + 32_000], None, cv2.INTER_LINEAR,
                       borderMode=cv2.BORDER_REPLICATE).reshape(-1, picture.shape[2])
             for start in range(0, len(places), 32_000)]
    return np.concatenate([np.zeros((0, picture.shape[2]), np.float32), *parts])


def panorama_axes(
    names: Sequence[str], cameras: Sequence[Camera]
) -> NDArray[np.float64]:  # [3, 3]
    """Returns the rotation from the world to a panorama, by views of its faces, at least one.

    Faces of a wide lens lie around its middle.
    """
    place = face_order(names[0])
    if place == len(CUBE):
        return middle_axes([camera.viewmat[:3, :3] for camera in cameras])
    return np.asarray(CUBE[place].rotation.T @ cameras[0].viewmat[:3, :3])


def panorama_size(camera: Camera) -> tuple[int, int]:
    """Returns the width and height of a panorama that is as fine as the middle of a face."""
    height = max(2, 2 * round(math.pi * camera.fx / 2))
    return 2 * height, height
