"""3D Scanner App ("All data"): frame_<n>.json with a pose each, frame_<n>.jpg for some of them.

cameraPoseARFrame is a 4x4 camera-to-world matrix row by row, ARKit's axes and world (metres, y up);
intrinsics a 3x3 matrix row by row, for the photo. depth_<n>.png is in millimetres, conf_<n>.png 0,
1, 2. (From readers of the app's export; it documents none itself.)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.frame_files import find_number, list_numbered, quoted
from recon_cli.datasets.frame_table import FrameTable, read_object, read_size
from recon_cli.datasets.posed import PosedImage, PosedSet

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
    images = list_numbered(folder, pattern="frame_([0-9]+)")
    texts = list_numbered(folder, (".json",), "frame_([0-9]+)")
    depths, levels = (list_numbered(folder, (".png",), f"{kind}_([0-9]+)")
                      for kind in ("depth", "conf"))
    table = FrameTable(folder, pictures=f"{quoted(folder)}/frame_*.jpg", opengl=True)
    for number, path in images.items():
        with table.frame(path.name):
            value = read_object(texts.get(number), "without a .json")
            size = read_size(path)
            viewmat = table.pose(value.get, _POSE)
            lens = table.lens(size, _intrinsics, value.get("intrinsics"))
            table.add(PosedImage(
                path.name, path, lens, viewmat, time=find_number(value, "time"),
                depth=lidar_depth(depths.get(number), levels.get(number), lens)))
    return table.finish_tracked(without_picture=len(texts.keys() - images.keys()))


def _intrinsics(matrix: Any) -> tuple[Any, ...]:
    fx, _, cx, _, fy, cy, _, _, _ = matrix
    return fx, fy, cx, cy
