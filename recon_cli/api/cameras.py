"""Cameras: made of intrinsics and a pose, or read from a COLMAP model, transforms.json and others.

Conventions are those of docs/conventions.md: OpenCV axes (x right, y down, z forward), and pixel
centres at +0.5, so that the principal point of a symmetric image is (width / 2, height / 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets import colmap, transforms
from recon_cli.datasets.layouts import read_posed
from recon_cli.errors import FormatError, InputError, list_names
from recon_cli.io.calibration import ORTHONORMAL, viewmat_from_pose
from recon_cli.scene.camera import MODELS, Camera, Lens, looking_at
from recon_cli.workspace.layout import Workspace

_POSE_HINT = "Give a rotation with a translation, without scale: [4, 4], last row 0 0 0 1."


def make_camera(
    K: NDArray[Any] | Sequence[Sequence[float]], width: int, height: int, *,
    viewmat: NDArray[Any] | Sequence[Sequence[float]] | None = None,
    pose: NDArray[Any] | Sequence[Sequence[float]] | None = None, opengl: bool = False,
) -> Camera:
    """Returns a pinhole camera of its intrinsics and one of its two matrices.

    Args:
        K: [3, 3] intrinsics in pixels, without skew.
        width: pixels.
        height: pixels.
        viewmat: [4, 4] world to camera.
        pose: [4, 4] camera to world.
        opengl: the axes of `pose` are those of OpenGL, Blender and nerfstudio: x right, y up,
            looking along -z.

    Raises:
        InputError: a matrix has the wrong shape or is not what it should be, or the size is none.
    """
    if (viewmat is None) == (pose is None):
        raise InputError("A camera needs viewmat or pose, one of them.",
                         hint="viewmat is world to camera, pose is camera to world.")
    if opengl and pose is None:
        raise InputError("opengl is about the axes of pose, which is not given.",
                         hint="Give pose=numpy.linalg.inv(viewmat).")
    fx, fy, cx, cy = _read_intrinsics(K)
    if min(width, height) < 1:
        raise InputError(f"The camera has {width}x{height} pixels.",
                         hint="Give width and height in pixels.")
    try:
        if pose is not None:
            matrix = viewmat_from_pose(pose, "pose", opengl=opengl)
        else:
            viewmat_from_pose(viewmat, "viewmat")  # is rigid
            matrix = np.eye(4)
            matrix[:3] = np.asarray(viewmat, np.float64).reshape(-1, 4)[:3]
    except FormatError as error:
        raise InputError(error.message, hint=_POSE_HINT) from error
    return Camera(int(width), int(height), fx, fy, cx, cy, matrix)


def look_at(
    eye: Sequence[float], target: Sequence[float], *, up: Sequence[float] = (0.0, 0.0, 1.0),
    width: int = 640, height: int = 480, fov_deg: float = 60.0,
) -> Camera:
    """Returns a level camera at `eye` that looks at `target`, both in world coordinates.

    `up` is the direction that is up in the image, `fov_deg` the angle between its left and right
    border. InputError if `eye` is `target`, the view is along `up`, or the angle is none.
    """
    at, to, above = (np.asarray(value, np.float64) for value in (eye, target, up))
    if any(value.shape != (3,) or not np.isfinite(value).all() for value in (at, to, above)):
        raise InputError("eye, target and up need three finite numbers each.",
                         hint="For example look_at((0, -3, 1.5), (0, 0, 1)).")
    if np.linalg.norm(np.cross(to - at, above)) < 1e-9 * np.linalg.norm(above) or not above.any():
        raise InputError("The camera looks along up, or at its own place.",
                         hint="Give another up, such as (0, 1, 0), or another target.")
    if not 0 < fov_deg < 180:
        raise InputError(f"fov_deg is {fov_deg:g}, needed between 0 and 180.",
                         hint="Give degrees; 60 is that of a phone.")
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return make_camera(K, width, height, viewmat=looking_at(at, to, above))


def read_cameras(path: str | Path, *, ignore_distortion: bool = False) -> dict[str, Camera]:
    """Returns the cameras of a data set by the names of its images, which need not be there.

    Args:
        path: a COLMAP model or a folder that holds one, a transforms.json (nerfstudio,
            instant-ngp) or its folder, a workspace (its undistorted views), or another data set
            with poses that `recon ingest` reads, with its images.
        ignore_distortion: return pinhole cameras of the same focal lengths for distorted ones.

    Raises:
        InputError: it is no such data set, or holds distorted cameras.
        FormatError: it is damaged.
    """
    path = Path(path)
    undistorted = Workspace(path).folder("place") / "undistorted" / "sparse"
    listed = _list_cameras(undistorted if undistorted.is_dir() else path)
    distorted = [name for name, lens, _ in listed if _is_distorted(lens)]
    if distorted and not ignore_distortion:
        raise InputError(
            f"{len(distorted)} of {len(listed)} cameras in {path} have lens distortion: "
            f"{list_names(distorted)}.",
            hint="Undistort the images (ingest and sfm of recon do, and so does COLMAP's "
            "image_undistorter), or pass ignore_distortion=True for the pinhole part alone.")
    return {name: lens.pinhole(viewmat) for name, lens, viewmat in listed}


def _list_cameras(path: Path) -> list[tuple[str, Lens, NDArray[np.float64]]]:
    if transforms.is_transforms(path):
        return transforms.list_cameras(path)
    if colmap.is_colmap(path):
        return colmap.list_cameras(path)
    if not path.exists():
        raise InputError(f"{path} does not exist.", hint="Check the path.")
    return [(image.name, image.lens, image.viewmat) for image in read_posed(path).images]


def _is_distorted(lens: Lens) -> bool:
    focals, _ = MODELS[lens.model]
    # a fisheye is no pinhole even where its coefficients are zero
    return "FISHEYE" in lens.model or any(lens.params[focals + 2:])


def _read_intrinsics(K: Any) -> tuple[float, float, float, float]:
    """Returns fx, fy, cx and cy of a matrix; InputError if it is no matrix of intrinsics."""
    hint = "Give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels."
    try:
        matrix = np.asarray(K, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("K is not a matrix of numbers.", hint=hint) from error
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise InputError(f"K has shape {matrix.shape}, needed a finite (3, 3).", hint=hint)
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    rest = [matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1]]
    if min(fx, fy) <= 0 or np.abs(rest).max() > 1e-3 * fx or abs(matrix[2, 2] - 1) > ORTHONORMAL:
        raise InputError("K is not a matrix of intrinsics without skew.", hint=hint)
    return fx, fy, float(matrix[0, 2]), float(matrix[1, 2])
