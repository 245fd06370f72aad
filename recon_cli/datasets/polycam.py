"""Polycam's raw data export: keyframes with images, cameras, LiDAR depth and confidence.

keyframes/{images,cameras,depth,confidence}/<t>.{jpg,json,png,png}, t in microseconds;
confidence is 0 to 255. Cameras hold
fx fy cx cy and a 3x4 camera-to-world matrix t_<row><column>, ARKit's camera axes, metres, y up.
corrected_images with corrected_cameras are undistorted and loop closed, and taken where both are
there, though a drift of a degree remains; the others keep a distortion that is written nowhere.
(PolyCam/polyform; nerfstudio's polycam_utils.) raw.glb lies in another frame and is not read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.frame_files import list_numbered
from recon_cli.datasets.frame_table import (
    FrameTable,
    MissingPictureError,
    read_object,
    read_size,
)
from recon_cli.datasets.posed import PosedImage, PosedSet

# Pixels along the border of undistorted images that may be black, as nerfstudio crops them of
# pictures of 1024x768; of smaller ones by share.
_RIM, _RIM_SHARE = 15, 0.02


def find_polycam(folder: Path) -> Path | None:
    """Returns the folder of the keyframes."""
    return next((place for place in (folder / "keyframes", folder)
                 if any((place / f"{kind}cameras").is_dir() and (place / f"{kind}images").is_dir()
                        for kind in ("corrected_", ""))), None)


def read_polycam(folder: Path) -> PosedSet:
    """Returns the keyframes; InputError if none has an image and a camera."""
    place = find_polycam(folder)
    assert place is not None
    for kind in ("corrected_", ""):
        images = list_numbered(place / f"{kind}images")
        cameras = list_numbered(place / f"{kind}cameras", (".json",))
        if images and cameras:
            break
    depths, levels = (list_numbered(place / name, (".png",)) for name in ("depth", "confidence"))
    table = FrameTable(folder, pictures=place / f"{kind}images", opengl=True)
    for number in dict.fromkeys([*images, *cameras]):
        path = images.get(number)
        with table.frame(f"{cameras[number].stem}.jpg" if path is None else path.name):
            if path is None:
                raise MissingPictureError
            value = read_object(cameras.get(number), "without a camera")
            size = _size(value, path)
            viewmat = table.pose(_pose, value)
            lens = table.lens(size, _intrinsics, value)
            rim = min(_RIM, math.ceil(_RIM_SHARE * min(size))) if kind else 0
            table.add(PosedImage(
                path.name, path, lens, viewmat, time=number / 1e6, rim=rim,
                depth=lidar_depth(depths.get(number), levels.get(number), lens, high=255)))
    if not kind:
        table.notices.append(
            "it has no corrected cameras (loop closure was off, or the capture too long): the "
            "poses drift, and the lens distortion is written nowhere")
    return table.finish_tracked()


def _pose(value: Mapping[str, Any]) -> list[list[float]]:
    """Returns camera to world, 3x4."""
    return [[float(value[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]


def _intrinsics(value: Mapping[str, Any]) -> list[Any]:
    return [value[key] for key in ("fx", "fy", "cx", "cy")]


def _size(value: Mapping[str, Any], path: Path) -> tuple[int, int]:
    """Returns the size that the intrinsics are for; recent exports leave it out."""
    try:
        return int(value["width"]), int(value["height"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return read_size(path)
