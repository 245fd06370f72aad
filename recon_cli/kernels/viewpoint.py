"""A camera as kernels take it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon_cli.scene.camera import Camera

MARGIN = 0.15  # of the image on each side, within which x/z and y/z are clamped


class Viewpoint(NamedTuple):
    """A camera as kernels take it: world to camera R x + t, pixels, limits of x/z and y/z."""

    R: np.ndarray  # [9] float64
    t: np.ndarray  # [3] float64
    center: np.ndarray  # [3] float64
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    tan_left: float
    tan_right: float
    tan_top: float
    tan_bottom: float


def viewpoint(camera: Camera) -> Viewpoint:
    """Returns a camera as kernels take it."""
    wide, high = MARGIN * camera.width, MARGIN * camera.height
    return Viewpoint(
        np.ascontiguousarray(camera.viewmat[:3, :3], np.float64).reshape(-1),
        np.ascontiguousarray(camera.viewmat[:3, 3], np.float64),
        np.ascontiguousarray(camera.center, np.float64),
        float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy),
        int(camera.width), int(camera.height),
        (-camera.cx - wide) / camera.fx, (camera.width - camera.cx + wide) / camera.fx,
        (-camera.cy - high) / camera.fy, (camera.height - camera.cy + high) / camera.fy)
