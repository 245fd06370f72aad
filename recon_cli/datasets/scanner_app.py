"""3D Scanner App ("All data"): frame_<n>.json with a pose each, frame_<n>.jpg for some of them.

cameraPoseARFrame is a 4x4 camera-to-world matrix row by row, ARKit's axes and world (metres, y up);
intrinsics a 3x3 matrix row by row, for the photo. depth_<n>.png is in millimetres, conf_<n>.png 0,
1, 2. (From readers of the app's export; it documents none itself.)
"""

from __future__ import annotations

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

_POSE = "cameraPoseARFrame"


def is_scanner_app(folder: Path) -> bool:
    """Returns whether a folder is a scan of 3D Scanner App."""
    if not folder.is_dir():
        return False
    first = next(iter(sorted(folder.glob("frame_*.json"))[:1]), None)
    try:
        return first is not None and (
            f'"{_POSE}"' in first.read_text(encoding="utf-8", errors="replace")
            or next(folder.glob("depth_[0-9]*.png"), None) is not None)
    except OSError:
        return False


def read_scanner_app(folder: Path) -> PosedSet:
    """Returns the frames that have a photo; InputError if none has a photo and a pose."""
    images = list_numbered(folder, PICTURES, "frame_")
    texts = list_numbered(folder, (".json",), "frame_")
    depths = list_numbered(folder, (".png",), "depth_")
    levels = list_numbered(folder, (".png",), "conf_")
    left_out, listed = LeftOut(), []
    for number, path in images.items():
        if number not in texts:
            left_out.add(path.name, "without a .json")
            continue
        image = _list_frame(path, texts[number], left_out)
        if image is not None:
            depth = lidar_depth(depths.get(number), levels.get(number), image[0])
            listed.append(PosedImage(
                path.name, path, image[0], image[1], depth=depth, time=image[2]))
    return tracked_set(
        "3dscannerapp", listed, folder, left_out, photos=f"{quoted(folder)}/frame_*.jpg",
        bare=len(set(texts) - set(images)))


def _list_frame(path: Path, text: Path, left_out: LeftOut) -> Any:
    """Returns lens, world to camera and time of a frame, None where one cannot be used."""
    value = left_out.json(text)
    if value is None:
        return None
    try:
        size = image_size(path)
    except FormatError:
        left_out.add(path.name, "that cannot be read")
        return None
    viewmat = left_out.pose(path.name, value.get, _POSE, opengl=True)
    if viewmat is None:
        return None
    lens = left_out.lens(path.name, size, _intrinsics, value.get("intrinsics"))
    if lens is None:
        return None
    time = value.get("time")
    return lens, viewmat, float(time) if isinstance(time, (int, float)) else None


def _intrinsics(matrix: Any) -> tuple[Any, ...]:
    fx, _, cx, _, fy, cy, _, _, _ = matrix
    return fx, fy, cx, cy
