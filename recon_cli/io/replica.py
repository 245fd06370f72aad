"""Replica sequences in the layout of NICE-SLAM.

results/frame%06d.jpg (or .png), results/depth%06d.png, traj.txt with one camera-to-world matrix
a frame (OpenCV axes, metres), and cam_params.json beside it or one level up, shared by all rooms.
Frames are matched by number, not by order: some may lack depth. A folder test/ of the same layout
holds novel views, which are held out for the score.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import make_lens, viewmat_from_pose
from recon_cli.io.posed import DepthFile, ListedImage, PosedSet, find_images
from recon_cli.scene.camera import Lens
from recon_cli.workspace.atomic import read_json

_FRAME = re.compile(r"frame(\d+)\.(jpg|jpeg|png)")
_TRAJ, _PARAMS = "traj.txt", "cam_params.json"


def is_replica(folder: Path) -> bool:
    """Returns whether a folder has the layout."""
    return (folder / _TRAJ).is_file() and (folder / "results").is_dir()


def lacks_trajectory(folder: Path) -> bool:
    """Returns whether a folder holds frames with depth as Replica does, but no poses."""
    results = folder / "results"
    return not (folder / _TRAJ).is_file() and all(
        next(results.glob(f"{kind}[0-9]*"), None) for kind in ("frame", "depth"))


def read_replica(folder: Path) -> PosedSet:
    """Returns a Replica sequence, its test/ folder held out.

    The principal point of cam_params.json counts from the centre of the first pixel and is moved
    by half a pixel.

    Raises:
        InputError: no image is there.
        FormatError: cam_params.json or traj.txt is missing or damaged, or does not fit the frames.
    """
    lens, scale = _read_params(folder)
    listed = _list_sequence(folder, lens, scale)
    splits = (folder / "test" / "results").is_dir()
    if splits:
        listed += _list_sequence(folder / "test", lens, scale, held_out=True)
    return replace(
        find_images("replica", listed, folder), metric=True, sequence=True, splits=splits)


def _read_params(folder: Path) -> tuple[Lens, float]:
    """Returns the lens, and the value of a metre in the depth files."""
    path = next((place / _PARAMS for place in (folder, folder.absolute().parent)
                 if (place / _PARAMS).is_file()), None)
    if path is None:
        raise FormatError(
            f"{folder} has no {_PARAMS}, neither beside {_TRAJ} nor one level up.",
            hint='Write one: {"camera": {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, '
            '"cx": 599.5, "cy": 339.5, "scale": 6553.5}} are the numbers of Replica.')
    value = read_json(path)
    try:
        camera: dict[str, Any] = value["camera"]
        width, height, fx, fy, cx, cy, scale = (
            float(camera[key]) for key in ("w", "h", "fx", "fy", "cx", "cy", "scale"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            f"{path} lacks a number: needed are w, h, fx, fy, cx, cy and scale under camera."
        ) from error
    if not (math.isfinite(scale) and scale > 0):
        raise FormatError(f"{path} has the depth scale {scale:g}; needed is one above 0.")
    lens = make_lens("PINHOLE", width, height, (fx, fy, cx + 0.5, cy + 0.5), str(path))
    return lens, scale


def _list_sequence(
    folder: Path, lens: Lens, scale: float, *, held_out: bool = False
) -> list[ListedImage]:
    """Returns the frames of one results/ folder by number."""
    files = {}
    for path in (folder / "results").iterdir():
        if match := _FRAME.fullmatch(path.name):
            files[int(match[1])] = path
    rows = _read_rows(folder / _TRAJ)
    _check_count(folder, sorted(files), len(rows))
    prefix = "test_" if held_out else ""
    digits = next((len(path.stem) - len("frame") for path in files.values()), 6)
    suffix = next((path.suffix for path in files.values()), ".jpg")
    listed = []
    for number in range(max(files) + 1):
        path = files.get(number, folder / "results" / f"frame{number:0{digits}d}{suffix}")
        viewmat = viewmat_from_pose(rows[number], f"{folder / _TRAJ}, line {number + 1},")
        depth = path.with_name(path.stem.replace("frame", "depth") + ".png")
        listed.append(ListedImage(
            prefix + path.name, path, lens, viewmat, held_out,
            DepthFile(depth, 1 / scale, lens) if depth.is_file() else None))
    return listed


def _check_count(folder: Path, numbers: list[int], rows: int) -> None:
    """Raises when traj.txt cannot belong to the frames."""
    if not numbers:
        raise InputError(
            f"{folder / 'results'} holds no frame000000.jpg or .png.",
            hint="The layout is results/frame%06d.jpg, results/depth%06d.png and traj.txt.")
    gaps = len(numbers) != numbers[-1] + 1
    # With frames left out in between, some may be left out at the end as well.
    if rows <= numbers[-1] or (rows != len(numbers) and not gaps):
        raise FormatError(
            f"{folder / _TRAJ} has {rows} poses, but the {len(numbers)} frames in results reach "
            f"from number {numbers[0]} to {numbers[-1]}: it is cut short or of another sequence.",
            hint="Copy traj.txt again; it has one line for each frame, the first for frame000000.")


def _read_rows(path: Path) -> list[NDArray[np.float64]]:
    """Returns the 16 numbers of each line that is not empty."""
    if not path.is_file():
        raise FormatError(
            f"{path} is missing.", hint="Copy it; it has one line for each frame of results.")
    rows = []
    for at, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = np.array(line.split(), np.float64)
        except ValueError as error:
            raise FormatError(f"{path}, line {at}, holds something other than numbers.") from error
        if row.size != 16:
            raise FormatError(
                f"{path}, line {at}, has {row.size} numbers, needed 16 of a 4x4 pose.")
        rows.append(row)
    return rows
