"""ARKitScenes, raw or 3dod: pictures by time, one .pincam each, and lowres_wide.traj.

<kind>/<id>_<ts>.png with <kind>_intrinsics/<id>_<ts>.pincam (w h fx fy cx cy), where kind is wide,
vga_wide or lowres_wide; lowres_depth/ in millimetres and confidence/ (0, 1, 2) of lowres_wide's
view, which is that of wide and vga_wide too. The .traj has a pose at about 10 Hz: ts, axis-angle in
radians, metres, world to camera, OpenCV's axes; z is up. Times of what belongs together differ by
up to a millisecond. (apple/ARKitScenes, DATA.md and tenFpsDataLoader.py.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.frame_files import list_timed
from recon_cli.datasets.frame_table import (
    Z_UP,
    FrameTable,
    LeftOutError,
    nearest,
    read_size,
)
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.datasets.trajectory import Trajectory
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.camera import Lens

_KINDS = ("wide", "vga_wide", "lowres_wide")  # the largest pictures first
_TRAJ = "lowres_wide.traj"
_NEAR = 0.0015  # seconds between files of one frame; they are written to the millisecond


def find_arkit_scenes(folder: Path) -> Path | None:
    """Returns the folder that holds the .traj beside pictures."""
    places = [folder, *sorted(folder.glob("*_frames"))] if folder.is_dir() else []
    return next((place for place in places if (place / _TRAJ).is_file()
                 and any((place / kind).is_dir() for kind in _KINDS)), None)


def read_arkit_scenes(folder: Path) -> PosedSet:
    """Returns the frames that have intrinsics and a pose near in time.

    InputError if there is none; FormatError if the poses are damaged.
    """
    home = find_arkit_scenes(folder)
    assert home is not None
    for kind in _KINDS:
        images = list_timed(home / kind)
        inner = list_timed(home / f"{kind}_intrinsics", (".pincam",))
        if images and inner:
            break
    depths, levels = (list_timed(home / name) for name in ("lowres_depth", "confidence"))
    trajectory = _read_trajectory(home / _TRAJ)
    table = FrameTable(folder, pictures=home / kind)
    for time, path in images.items():
        with table.frame(path.name):
            lens = _read_lens(nearest(inner, time, _NEAR), path, table)
            viewmat = trajectory.viewmat(time)
            if viewmat is None:
                raise LeftOutError("without a pose near in time")
            depth = lidar_depth(nearest(depths, time, _NEAR), nearest(levels, time, _NEAR), lens)
            table.add(PosedImage(path.name, path, lens, viewmat, depth=depth, time=time))
    return table.finish_tracked(
        up=Z_UP, without_picture=sum(nearest(images, time, _NEAR) is None for time in inner))


def _read_lens(text: Path | None, image: Path, table: FrameTable) -> Lens:
    if text is None:
        raise LeftOutError("without a .pincam of their time")
    read_size(image)
    try:
        width, height, *inner = map(float, text.read_text(encoding="utf-8").split())
        size = round(width), round(height)
    except (OSError, ValueError, OverflowError) as error:
        raise LeftOutError("whose .pincam cannot be read") from error
    return table.lens(size, tuple, inner)


def _read_trajectory(path: Path) -> Trajectory:
    """Returns the poses of a .traj; a last line that is cut short is left out.

    FormatError if it is damaged; InputError if it holds fewer than two.
    """
    lines = [line.split() for line in
             path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    if lines and len(lines[-1]) != 7:
        lines.pop()
    try:
        values = np.array(lines, np.float64).reshape(-1, 7)
    except ValueError as error:
        raise FormatError(f"{path} does not hold 7 numbers a line.") from error
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        raise InputError(f"{path} holds {len(values)} poses.", hint="Download it again.")
    turns = Rotation.from_rotvec(values[:, 1:4]).inv()
    return Trajectory(values[:, 0], turns, -turns.apply(values[:, 4:7]))
