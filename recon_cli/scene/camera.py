"""A pinhole camera in the conventions of docs/conventions: OpenCV axes, pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera at a place.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        fx: focal length in pixels along x.
        fy: focal length in pixels along y.
        cx: principal point in pixels; the centre of the first pixel lies at 0.5.
        cy: principal point in pixels.
        viewmat: [4, 4] float64, world to camera; x right, y down, z forward.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    viewmat: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a camera of {self.width}x{self.height} pixels")
        if self.viewmat.shape != (4, 4):
            raise ValueError(f"viewmat has shape {self.viewmat.shape}, needed (4, 4)")

    @property
    def center(self) -> NDArray[np.float64]:
        """The optical centre in world coordinates, [3]."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    def resized(self, width: int, height: int) -> Camera:
        """Returns the camera of the same view resampled to width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height,
            fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy,
        )


def looking_at(
    eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns [4, 4] world to camera at `eye` with `target` in the middle and the horizon level.

    The line of sight may not be parallel to `up`.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat
