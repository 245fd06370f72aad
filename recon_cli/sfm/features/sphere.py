"""Geometry of matches in panoramas, whose rays point in all directions.

A pinhole camera compares places in its image plane. Here each ray gets a plane of its own, at right
angles to it, in which directions near it have coordinates; a pixel is its share of a radian.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.camera import PANORAMA


def is_panorama(camera: pycolmap.Camera) -> bool:
    """Returns whether a camera sees all directions."""
    return str(camera.model_name) == PANORAMA


def radian_px(camera: pycolmap.Camera) -> float:
    """Returns the pixels of a radian in the middle of an image."""
    return float(
        camera.width / (2 * np.pi) if is_panorama(camera) else camera.mean_focal_length())


def unit_rays(camera: pycolmap.Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the unit vectors [M, 3] through pixels [M, 2], in the axes of the camera."""
    return np.asarray(camera.cam_ray_from_img(pixels), np.float64).reshape(-1, 3)


def ray_frames(rays: NDArray[np.float64]) -> NDArray[np.float64]:  # [M, 3, 3]
    """Returns a rotation for each unit vector [M, 3] that turns it onto z."""
    aside = np.eye(3)[np.argmin(np.abs(rays), axis=1)]
    x = np.cross(aside, rays)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(rays, x), rays], axis=1)


def epipolar_errors(
    ours: NDArray[np.float64],  # [M, 3] unit vectors in the first camera
    theirs: NDArray[np.float64],  # [M, 3] in the second
    motion: pycolmap.Rigid3d,  # from the first to the second
) -> NDArray[np.float64]:  # [M]
    """Returns how far the rays of matches are from one plane through both cameras, radians.

    It is Sampson's distance on the sphere; NaN where the cameras stand in one place.
    """
    x, y, z = motion.translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion.rotation.matrix()
    lines, back = ours @ essential.T, theirs @ essential
    product = (theirs * lines).sum(axis=1)
    slopes = ((lines**2).sum(axis=1) - product**2) + ((back**2).sum(axis=1) - product**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(product) / np.sqrt(slopes))
