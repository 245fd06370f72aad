"""ARKitScenes, raw or 3dod: pictures by time, one .pincam each, and lowres_wide.traj.

<kind>/<id>_<ts>.png with <kind>_intrinsics/<id>_<ts>.pincam (w h fx fy cx cy), where kind is wide,
vga_wide or lowres_wide; lowres_depth/ in millimetres and confidence/ (0, 1, 2) of lowres_wide's
view, which is that of wide and vga_wide too. The .traj has a pose at about 10 Hz: ts, axis-angle in
radians, metres, world to camera, OpenCV's axes; z is up. Times of what belongs together differ by
up to a millisecond. (apple/ARKitScenes, DATA.md and tenFpsDataLoader.py.)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon_cli.datasets.app_frames import (
    PICTURES,
    Z_UP,
    LeftOut,
    quoted,
    tracked_set,
)
from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.datasets.trajectory import Trajectory
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.camera import Lens

_KINDS = ("wide", "vga_wide", "lowres_wide")  # the largest pictures first
_TRAJ = "lowres_wide.traj"
_NEAR = 0.0015  # seconds between files of one frame; they are written to the millisecond
_HINT = "Download the recording again."


def is_arkit_scenes(folder: Path) -> bool:
    """Returns whether a folder is a recording of ARKitScenes, raw or in the 3dod part."""
    return _home(folder) is not None


def _home(folder: Path) -> Path | None:
    """Returns the folder that holds the .traj beside pictures."""
    places = [folder, *sorted(folder.glob("*_frames"))] if folder.is_dir() else []
    return next((place for place in places if (place / _TRAJ).is_file()
                 and any((place / kind).is_dir() for kind in _KINDS)), None)


def read_arkit_scenes(folder: Path) -> PosedSet:
    """Returns the frames that have intrinsics and a pose near in time.

    InputError if there is none; FormatError if the poses are damaged.
    """
    home = _home(folder)
    assert home is not None
    kind = next((kind for kind in _KINDS if _by_time(home / kind) and _by_time(
        home / f"{kind}_intrinsics", (".pincam",))), _KINDS[-1])
    images = _by_time(home / kind)
    inner = _by_time(home / f"{kind}_intrinsics", (".pincam",))
    depths, levels = _by_time(home / "lowres_depth"), _by_time(home / "confidence")
    path = _read_trajectory(home / _TRAJ)
    left_out, listed = LeftOut(), []
    for time, image in images.items():
        text = _nearest(inner, time)
        if text is None:
            left_out.add(image.name, "without a .pincam of their time")
            continue
        lens = _read_lens(text, image, left_out)
        if lens is None:
            continue
        viewmat = path.viewmat(time)
        if viewmat is None:
            left_out.add(image.name, "without a pose near in time")
            continue
        depth = lidar_depth(_nearest(depths, time), _nearest(levels, time), lens)
        listed.append(PosedImage(image.name, image, lens, viewmat, depth=depth, time=time))
    return tracked_set(
        "arkitscenes", listed, folder, left_out, up=Z_UP, photos=quoted(home / kind),
        bare=sum(_nearest(images, time) is None for time in inner))


def _by_time(folder: Path, suffixes: tuple[str, ...] = PICTURES) -> dict[float, Path]:
    """Returns the files that are named <id>_<ts>, in order of time."""
    if not folder.is_dir():
        return {}
    found = {}
    for path in folder.iterdir():
        text = path.name[:-len(path.suffix)].rpartition("_")[2]
        if path.suffix.lower() in suffixes and text.replace(".", "", 1).isdecimal():
            found[float(text)] = path
    return dict(sorted(found.items()))


def _nearest(files: Mapping[float, Path], time: float) -> Path | None:
    """Returns the file of a time, to a millisecond."""
    if time in files:
        return files[time]
    near = min(files, key=lambda one: abs(one - time), default=None)
    return files[near] if near is not None and abs(near - time) <= _NEAR else None


def _read_lens(text: Path, image: Path, left_out: LeftOut) -> Lens | None:
    try:
        width, height, *inner = map(float, text.read_text(encoding="utf-8").split())
        size = round(width), round(height)
        image_size(image)
    except (OSError, ValueError, OverflowError, FormatError):
        left_out.add(image.name, "whose .pincam or picture cannot be read")
        return None
    return left_out.lens(image.name, size, tuple, inner)


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
        raise FormatError(f"{path} does not hold 7 numbers a line.", hint=_HINT) from error
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        raise InputError(f"{path} holds {len(values)} poses.", hint=_HINT)
    turns = Rotation.from_rotvec(values[:, 1:4]).inv()
    return Trajectory(values[:, 0], turns, -turns.apply(values[:, 4:7]))
