"""From pixels of a distorted lens to the directions of their rays."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.lens import MODELS, Lens

_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE")
_PERSPECTIVE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
# Each step shrinks the error by about the distortion itself: 50 undo 50% to 1e-15.
_STEPS = 50


def directions(
    lens: Lens,
    pixels: NDArray[np.float64],  # [M, 2]
) -> NDArray[np.float64]:
    """Returns [M, 2] x/z and y/z of the rays through pixels, distortion undone.

    Args:
        lens: intrinsics of every model but THIN_PRISM_FISHEYE.
        pixels: x and y; the centre of the first pixel lies at 0.5.

    Raises:
        ValueError: the lens is a THIN_PRISM_FISHEYE, which OpenCV does not have either.
    """
    focals, _ = MODELS[lens.model]
    focal = np.array([lens.params[0], lens.params[focals - 1]])
    distorted = (pixels - lens.params[focals:focals + 2]) / focal
    coefficients = lens.params[focals + 2:]
    if lens.model in _PINHOLE or not len(pixels):
        return np.asarray(distorted)
    if lens.model in _PERSPECTIVE:
        return _undo(distorted, np.array([*coefficients, *[0.0] * (8 - len(coefficients))]))
    if lens.model not in _FISHEYE:
        raise ValueError(f"{lens.model} cannot be undone")
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, 1e-12)
    padded = np.array([*coefficients, *[0.0] * (4 - len(coefficients))])
    undone = cv2.fisheye.undistortPoints(
        np.ascontiguousarray(distorted)[:, None], np.eye(3), padded, criteria=stop)
    return np.asarray(undone, np.float64)[:, 0]


def _undo(distorted: NDArray[np.float64], k: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverts k1 k2 p1 p2 k3 k4 k5 k6 by the fixed point that cv2.undistortPoints iterates.

    Here rather than by OpenCV, whose versions 4 and 5 take the number of steps in different calls,
    and whose default of five leaves 0.04 pixels at the corners of a lens with k1 = -0.28.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    undone = distorted.copy()
    for _ in range(_STEPS):
        x, y = undone.T
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        shift = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                          p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1)
        undone = (distorted - shift) / radial[:, None]
    return undone
