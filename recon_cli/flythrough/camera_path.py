"""Reads and writes camera paths in the JSON format of nerfstudio's viewer.

`camera_path` lists `camera_to_world` (16 numbers row by row, OpenGL axes: x right, y up, looking
along -z) and `fov` (vertical, in degrees); `render_width` and `render_height` hold for all frames.
Pixels are square and the principal point is the image centre (nerfstudio's
cameras/camera_paths.py). Poses are in the world of the scene that the file was made for.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.transforms import read_number
from recon_cli.errors import FormatError
from recon_cli.io.calibration import pose_from_viewmat, viewmat_from_pose
from recon_cli.scene.camera import Camera
from recon_cli.workspace.atomic import read_json, write_json

_FOV_DEG = (1.0, 170.0)  # a wider one fails the affine approximation of a Gaussian's projection
_HINT = "Export the path again from the program that wrote it."

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A sequence of F cameras of one size."""

    viewmats: NDArray[np.float64]  # [F, 4, 4] world to camera, OpenCV axes
    fovs_deg: NDArray[np.float64]  # [F] vertical
    width: int  # in pixels
    height: int
    fps: float | None = None  # None if the file has none

    def cameras(self) -> list[Camera]:
        """Returns the cameras, with square pixels and a central principal point."""
        focals = self.height / 2 / np.tan(np.radians(self.fovs_deg) / 2)
        return [
            Camera(self.width, self.height, float(focal), float(focal), self.width / 2,
                   self.height / 2, viewmat)
            for viewmat, focal in zip(self.viewmats, focals, strict=True)]


def write_camera_path(path: Path, cameras: CameraPath) -> None:
    """Writes a path that nerfstudio and `read_camera_path` read, atomically."""
    fps = cameras.fps or 1.0
    aspect = cameras.width / cameras.height
    write_json(path, {
        "camera_type": "perspective",
        "render_width": cameras.width, "render_height": cameras.height,
        "fps": fps, "seconds": len(cameras.viewmats) / fps, "is_cycle": False, "keyframes": [],
        "camera_path": [
            {"camera_to_world": pose_from_viewmat(viewmat).ravel().tolist(), "fov": float(fov),
             "aspect": aspect}
            for viewmat, fov in zip(cameras.viewmats, cameras.fovs_deg, strict=True)],
    })


def read_camera_path(path: Path) -> CameraPath:
    """Returns the cameras of a file.

    FormatError if it is missing or no JSON, lists no cameras, or one lacks a finite rigid pose or a
    valid field of view.
    """
    value = read_json(path, hint=_HINT, finite=False)
    entries = value.get("camera_path") if isinstance(value, dict) else None
    if not isinstance(entries, list) or not entries:
        raise FormatError(
            f"{path} lists no cameras: `camera_path` must be a list of at least one.", hint=_HINT)
    kind = value.get("camera_type", "perspective")
    if kind != "perspective":
        raise FormatError(
            f"{path} has the camera type {kind!r}; only perspective cameras can be rendered.",
            hint="Export the path again with perspective cameras.")
    if value.get("crop") is not None:
        logger.warning("%s: its crop is ignored, all of the scene is rendered", path)
    sides = {key: _read_number(value, key, str(path)) for key in ("render_width", "render_height")}
    for key, pixels in sides.items():
        if pixels < 1 or pixels != round(pixels):
            raise FormatError(
                f"{path} has {key} = {pixels:g}; it must be an integer.", hint=_HINT)
    frames = [_read_frame(entry, f"{path}, camera {at},") for at, entry in enumerate(entries)]
    return CameraPath(
        np.stack([viewmat for viewmat, _ in frames]), np.array([fov for _, fov in frames]),
        round(sides["render_width"]), round(sides["render_height"]),
        _read_fps(value, len(entries), path))


def _read_frame(entry: Any, where: str) -> tuple[NDArray[np.float64], float]:
    """Returns the world-to-camera matrix and the vertical field of view in degrees."""
    if not isinstance(entry, dict):
        raise FormatError(f"{where} is not a JSON object.", hint=_HINT)
    if "camera_to_world" not in entry:
        raise FormatError(f"{where} has no camera_to_world.", hint=_HINT)
    viewmat = viewmat_from_pose(entry["camera_to_world"], f"{where} camera_to_world", opengl=True)
    fov = _read_number(entry, "fov", where)
    if not _FOV_DEG[0] <= fov <= _FOV_DEG[1]:
        raise FormatError(
            f"{where} has a fov of {fov:g} degrees; it must be {_FOV_DEG[0]:g} to "
            f"{_FOV_DEG[1]:g}.", hint=_HINT)
    return viewmat, fov


def _read_fps(value: Mapping[str, Any], frames: int, path: Path) -> float | None:
    """Returns the frames a second, if need be from the total seconds; None without either."""
    fps, seconds = (read_number(value, key, str(path)) for key in ("fps", "seconds"))
    if fps is None:
        if seconds is None:
            return None
        fps = frames / seconds if seconds > 0 else 0.0
    if not 0 < fps <= 1000:
        raise FormatError(
            f"{path} has {fps:g} frames a second; it must be above 0 and at most 1000.", hint=_HINT)
    return fps


def _read_number(entry: Mapping[str, Any], key: str, where: str) -> float:
    value = read_number(entry, key, where)
    if value is None:
        raise FormatError(f"{where} has no {key}.", hint=_HINT)
    return value
