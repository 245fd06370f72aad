"""Checked poses and intrinsics from files, and the undistortion of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens, make_lens

# Entries of three decimals are off by 5e-4, so R R^T by up to 2 * sqrt(3) * 5e-4 = 1.7e-3.
ORTHONORMAL = 2e-3
FARTHEST = 1e9  # UTM, the largest coordinates in use, reach 1e7 metres
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # y up and z backward, from y down and z forward
_HINT = "Export the poses again, or take the image out of the list."


def viewmat_from_pose(value: Any, where: str, *, opengl: bool = False) -> NDArray[np.float64]:
    """Returns [4, 4] world to camera, OpenCV axes, of a camera-to-world matrix.

    `value` is 16 numbers row by row, [4, 4], or [3, 4] without its last row; `where` names it in
    messages. With `opengl` its camera looks along -z with y up, as in OpenGL and Blender. A
    rotation that is not orthonormal by rounding is replaced by the nearest one. FormatError if it
    is not a finite rigid matrix.
    """
    pose = _matrix(value, where)
    rotation = pose[:3, :3]
    askew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if askew > ORTHONORMAL or np.linalg.det(rotation) < 0:
        raise FormatError(
            f"{where} is not a rigid pose: {_fault(rotation, askew)}. Needed is a rotation with a "
            "position, without scale or reflection.", hint=_HINT)
    left, _, right = np.linalg.svd(rotation)
    nearest = left @ right
    viewmat = np.eye(4)
    viewmat[:3, :3] = nearest.T
    viewmat[:3, 3] = -nearest.T @ pose[:3, 3]
    return _OPENGL @ viewmat if opengl else viewmat


def pose_from_viewmat(viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [4, 4] camera to world with OpenGL axes: the inverse of `viewmat_from_pose`."""
    pose = np.eye(4)
    pose[:3, :3] = viewmat[:3, :3].T
    pose[:3, 3] = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return pose @ _OPENGL


def rotation_matrix(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the [3, 3] rotation of a unit quaternion wxyz."""
    w, x, y, z = quat
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def _matrix(value: Any, where: str) -> NDArray[np.float64]:
    """Returns a finite [4, 4] matrix whose last row is 0 0 0 1."""
    try:
        pose = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{where} is not a matrix of numbers.", hint=_HINT) from error
    if pose.size == 12 and pose.shape == (3, 4):
        pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
    if pose.size != 16:
        raise FormatError(f"{where} has {pose.size} numbers, needed 16 of a 4x4 pose.", hint=_HINT)
    pose = pose.reshape(4, 4)
    if not np.isfinite(pose).all():
        raise FormatError(f"{where} holds a number that is not finite.", hint=_HINT)
    if np.abs(pose[:3, 3]).max() > FARTHEST:
        raise FormatError(
            f"{where} puts the camera at {_numbers(pose[:3, 3])}, out of range.", hint=_HINT)
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > ORTHONORMAL:
        raise FormatError(
            f"{where} is not a rigid pose: its last row is {_numbers(pose[3])}, needed 0 0 0 1.",
            hint=_HINT)
    return pose


def _fault(rotation: NDArray[np.float64], askew: float) -> str:
    sizes = np.linalg.norm(rotation, axis=0)
    scale = float(sizes.mean())
    if scale > 0 and np.abs(rotation @ rotation.T / scale**2 - np.eye(3)).max() <= ORTHONORMAL:
        return f"scaled by {scale:.4g}" if askew > ORTHONORMAL else "a reflection"
    return f"its axes are {_numbers(sizes)} long or not at right angles"


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.4g}" for value in values)


def lens_from_matrix(matrix: NDArray[np.float64], width: int, height: int, where: str) -> Lens:
    """Returns the PINHOLE intrinsics of a [3, 3] or [4, 4] matrix K.

    In K the centre of the first pixel is at 0, here at 0.5. FormatError if K is skewed or invalid.
    """
    if matrix.shape[0] < 3 or matrix.shape[1] < 3 or not np.isfinite(matrix).all():
        raise FormatError(f"{where} is not a finite 3x3 or 4x4 matrix.")
    if abs(matrix[0, 1]) > 1e-3 * abs(matrix[0, 0]) or abs(matrix[2, 2] - 1) > ORTHONORMAL:
        raise FormatError(f"{where} is not a matrix of intrinsics without skew.")
    params = (matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5)
    return make_lens("PINHOLE", width, height, params, where)


# Pixels by which a ray that is projected again may miss. COLMAP's inversion of a fisheye ends far
# from the solution for some pixels towards the edge.
_MISS = 0.01


def undistort_pixels(
    lens: Lens,
    pixels: NDArray[np.float64],  # [M, 2]
) -> NDArray[np.float64]:
    """Returns [M, 2] undistorted x/z and y/z of pixels, by COLMAP.

    NaN where there are none: of a direction at right angles to the axis or behind the camera, or
    of a pixel that no direction is shown at.
    """
    # `recon convert` reads poses too, and starts without it
    from recon_cli.io.depth_maps import lens_camera

    camera = lens_camera(lens)
    undone = np.array(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)
    again = np.array(camera.img_from_cam(np.column_stack([undone, np.ones(len(undone))])))
    found = np.abs(again.reshape(-1, 2) - pixels).max(axis=1, initial=0.0) <= _MISS
    return np.where(found[:, None], undone, np.nan)
