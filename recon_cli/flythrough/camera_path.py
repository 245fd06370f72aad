"""The camera path of nerfstudio's viewer as a file, which other programs read and write.

`camera_path` lists `camera_to_world` (16 numbers row by row, OpenGL axes: x right, y up, looking
along -z) and `fov` (vertical, in degrees); `render_width` and `render_height` are those of all.
Pixels are square and the principal point lies in the middle. The layout is that of nerfstudio's
cameras/camera_paths.py. Cameras are in the world of the scene that the file was made for.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.calibration import viewmat_from_pose
from recon_cli.io.transforms import number
from recon_cli.scene.camera import Camera
from recon_cli.workspace.atomic import read_json, write_json

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # y up and z backward, from y down and z forward
# The focal length of a wider view falls below a twentieth of the height, where a Gaussian's
# projection is far from the affine one that is drawn; a narrower one is no view of a room.
_FOV_DEG = (1.0, 170.0)
_HINT = "Export the path again from the program that it came from."

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras one after the other, all of one size.

    Attributes:
        viewmats: [F, 4, 4] world to camera, OpenCV axes.
        fovs_deg: [F] vertical fields of view in degrees.
        width: of the pictures in pixels.
        height: of the pictures in pixels.
        fps: frames a second; None where a file does not say.
    """

    viewmats: NDArray[np.float64]
    fovs_deg: NDArray[np.float64]
    width: int
    height: int
    fps: float | None = None

    def cameras(self) -> list[Camera]:
        """Returns the cameras; all have square pixels and look through the middle."""
        focals = self.height / 2 / np.tan(np.radians(self.fovs_deg) / 2)
        return [
            Camera(self.width, self.height, float(focal), float(focal), self.width / 2,
                   self.height / 2, viewmat)
            for viewmat, focal in zip(self.viewmats, focals, strict=True)]


def write_camera_path(path: Path, cameras: CameraPath) -> None:
    """Writes a path that nerfstudio and `read_camera_path` read, whole or not at all."""
    fps = cameras.fps or 1.0
    aspect = cameras.width / cameras.height
    write_json(path, {
        "camera_type": "perspective",
        "render_width": cameras.width, "render_height": cameras.height,
        "fps": fps, "seconds": len(cameras.viewmats) / fps, "is_cycle": False, "keyframes": [],
        "camera_path": [
            {"camera_to_world": _pose(viewmat).ravel().tolist(), "fov": float(fov),
             "aspect": aspect}
            for viewmat, fov in zip(cameras.viewmats, cameras.fovs_deg, strict=True)],
    })


def _pose(viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [4, 4] camera to world, OpenGL axes."""
    pose = np.eye(4)
    pose[:3, :3] = viewmat[:3, :3].T
    pose[:3, 3] = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return pose @ _OPENGL


def read_camera_path(path: Path) -> CameraPath:
    """Returns the cameras of a file.

    Raises:
        FormatError: the file is missing or no JSON, lists no cameras, or one lacks a rigid finite
            pose or a field of view that a picture can have.
    """
    value = read_json(path)
    entries = value.get("camera_path") if isinstance(value, dict) else None
    if not isinstance(entries, list) or not entries:
        raise FormatError(
            f"{path} lists no cameras: needed is `camera_path`, a list of at least one.",
            hint=_HINT)
    kind = value.get("camera_type", "perspective")
    if kind != "perspective":
        raise FormatError(
            f"{path} is of the camera type {kind!r}; only perspective cameras can be rendered.",
            hint="Export the path again with perspective cameras.")
    if value.get("crop") is not None:
        logger.warning("%s: its crop is left out, the whole scene is rendered", path)
    width, height = (_pixels(value, key, path) for key in ("render_width", "render_height"))
    frames = [_frame(entry, f"{path}, camera {at},") for at, entry in enumerate(entries)]
    return CameraPath(
        np.stack([viewmat for viewmat, _ in frames]), np.array([fov for _, fov in frames]),
        width, height, _fps(value, len(entries), path))


def _frame(entry: Any, where: str) -> tuple[NDArray[np.float64], float]:
    """Returns the world-to-camera matrix and the vertical field of view in degrees."""
    if not isinstance(entry, dict):
        raise FormatError(f"{where} is no entry with names.", hint=_HINT)
    if "camera_to_world" not in entry:
        raise FormatError(f"{where} has no camera_to_world.", hint=_HINT)
    viewmat = viewmat_from_pose(
        entry["camera_to_world"], f"{where} camera_to_world", opengl=True)
    fov = _needed(entry, "fov", where)
    if not _FOV_DEG[0] <= fov <= _FOV_DEG[1]:
        raise FormatError(
            f"{where} has a fov of {fov:g} degrees; needed are {_FOV_DEG[0]:g} to "
            f"{_FOV_DEG[1]:g}.", hint=_HINT)
    return viewmat, fov


def _pixels(value: Mapping[str, Any], key: str, path: Path) -> int:
    pixels = _needed(value, key, str(path))
    if pixels < 1 or pixels != round(pixels):
        raise FormatError(f"{path} has {key} = {pixels:g}; needed are whole pixels.", hint=_HINT)
    return round(pixels)


def _fps(value: Mapping[str, Any], frames: int, path: Path) -> float | None:
    """Returns the frames a second, which may be said by the seconds of all; None without both."""
    fps, seconds = (number(value, key, str(path)) for key in ("fps", "seconds"))
    if fps is None:
        if seconds is None:
            return None
        fps = frames / seconds if seconds > 0 else 0.0
    if not 0 < fps <= 1000:
        raise FormatError(
            f"{path} plays {fps:g} frames a second; needed is more than 0, up to 1000.", hint=_HINT)
    return fps


def _needed(entry: Mapping[str, Any], key: str, where: str) -> float:
    value = number(entry, key, where)
    if value is None:
        raise FormatError(f"{where} has no {key}.", hint=_HINT)
    return value
