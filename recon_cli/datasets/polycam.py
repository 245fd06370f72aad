"""Polycam's raw data export: keyframes with images, cameras, LiDAR depth and confidence.

keyframes/{images,cameras,depth,confidence}/<t>.{jpg,json,png,png}, t in microseconds. Cameras hold
fx fy cx cy and a 3x4 camera-to-world matrix t_<row><column>, ARKit's camera axes, metres, y up.
corrected_images with corrected_cameras are undistorted and loop closed, and taken where both are
there, though a drift of a degree remains; the others keep a distortion that is written nowhere.
(PolyCam/polyform; nerfstudio's polycam_utils.) raw.glb lies in another frame and is not read.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from recon_cli.datasets.app_frames import (
    PICTURES,
    LeftOut,
    list_numbered,
    quoted,
    tracked_set,
)
from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError

# Pixels along the border of undistorted images that may be black, as nerfstudio crops them of
# pictures of 1024x768; of smaller ones by share.
_RIM, _RIM_SHARE = 15, 0.02
_HIGH = 255  # in the files of confidence


def is_polycam(folder: Path) -> bool:
    """Returns whether a folder is an export of Polycam, or its keyframes."""
    return _keyframes(folder) is not None


def _keyframes(folder: Path) -> Path | None:
    """Returns the folder of the keyframes."""
    return next((place for place in (folder / "keyframes", folder)
                 if any((place / f"{kind}cameras").is_dir() and (place / f"{kind}images").is_dir()
                        for kind in ("corrected_", ""))), None)


def read_polycam(folder: Path) -> PosedSet:
    """Returns the keyframes; InputError if none has an image and a camera."""
    place = _keyframes(folder)
    assert place is not None
    kind = "corrected_" if all(
        list_numbered(place / name, suffixes) for name, suffixes in (
            ("corrected_images", PICTURES), ("corrected_cameras", (".json",)))) else ""
    images = list_numbered(place / f"{kind}images", PICTURES)
    cameras = list_numbered(place / f"{kind}cameras", (".json",))
    depths = list_numbered(place / "depth", (".png",))
    levels = list_numbered(place / "confidence", (".png",))
    left_out, listed, missing = LeftOut(), [], []
    for number, path in images.items():
        if number not in cameras:
            left_out.add(path.name, "without a camera")
    for number, camera in cameras.items():
        if number not in images:
            missing.append(f"{camera.stem}.jpg")
            continue
        image = _list_keyframe(images[number], camera, left_out)
        if image is None:
            continue
        depth = lidar_depth(depths.get(number), levels.get(number), image.lens, high=_HIGH)
        listed.append(replace(image, depth=depth, rim=_rim(image) if kind else 0))
    posed = tracked_set(
        "polycam", listed, folder, left_out, missing=missing,
        photos=quoted(place / f"{kind}images"))
    if kind:
        return posed
    return replace(posed, notices=(*posed.notices, (
        "it has no corrected cameras (loop closure was off, or the capture too long): the poses "
        "drift, and the lens distortion is written nowhere")))


def _rim(image: PosedImage) -> int:
    return min(_RIM, math.ceil(_RIM_SHARE * min(image.lens.width, image.lens.height)))


def _list_keyframe(path: Path, camera: Path, left_out: LeftOut) -> PosedImage | None:
    """Returns an image with its camera, None where one of them cannot be used."""
    value = left_out.json(camera)
    if value is None:
        return None
    try:
        size = _size(value, path)
    except FormatError:
        left_out.add(path.name, "that cannot be read")
        return None
    viewmat = left_out.pose(path.name, _pose, value, opengl=True)
    if viewmat is None:
        return None
    lens = left_out.lens(path.name, size, _intrinsics, value)
    if lens is None:
        return None
    return PosedImage(path.name, path, lens, viewmat, time=int(path.stem) / 1e6)


def _pose(value: dict[str, Any]) -> list[list[float]]:
    """Returns camera to world, 3x4."""
    return [[float(value[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]


def _intrinsics(value: dict[str, Any]) -> list[Any]:
    return [value[key] for key in ("fx", "fy", "cx", "cy")]


def _size(value: dict[str, Any], path: Path) -> tuple[int, int]:
    """Returns the size that the intrinsics are for; recent exports leave it out."""
    try:
        return int(value["width"]), int(value["height"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return image_size(path)
