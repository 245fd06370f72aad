"""RGB-D sequences: Replica in the layout of NICE-SLAM, and ScanNet as its exporters write it.

Replica: results/frame%06d.jpg (or .png), results/depth%06d.png, traj.txt with one camera-to-world
matrix a frame (OpenCV axes, metres), and cam_params.json beside it or one level up. Frames are
matched by number, not by order: some may lack depth. A folder test/ of the same layout holds novel
views, which are held out for the score.

ScanNet: color/<n>.jpg, depth/<n>.png in millimetres, pose/<n>.txt with a camera-to-world matrix
(OpenCV axes, metres; -inf where tracking was lost), intrinsic/intrinsic_color.txt and
intrinsic_depth.txt. It unprojects integer pixel indices, so its pixel centres lie at integers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.app_frames import PICTURES, list_numbered
from recon_cli.datasets.depth_file import MILLIMETRE, DepthFile
from recon_cli.datasets.posed import PosedImage, PosedSet, find_images, image_size
from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import lens_from_matrix, viewmat_from_pose
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_json

_FRAME = re.compile(r"frame(\d+)\.(jpg|jpeg|png)")
_TRAJ, _PARAMS = "traj.txt", "cam_params.json"


def is_replica(folder: Path) -> bool:
    """Returns whether a folder has the layout of Replica."""
    return (folder / _TRAJ).is_file() and (folder / "results").is_dir()


def lacks_trajectory(folder: Path) -> bool:
    """Returns whether a folder holds frames with depth as Replica does, but no poses."""
    results = folder / "results"
    return not (folder / _TRAJ).is_file() and all(
        next(results.glob(f"{kind}[0-9]*"), None) for kind in ("frame", "depth"))


def read_replica(folder: Path) -> PosedSet:
    """Returns a Replica sequence, its test/ folder held out.

    InputError if there are no images; FormatError if a file is missing, damaged or does not fit.
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
    value = read_json(path, finite=False)
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
    # There the principal point counts from the centre of the first pixel.
    return make_lens("PINHOLE", width, height, (fx, fy, cx + 0.5, cy + 0.5), str(path)), scale


def _list_sequence(
    folder: Path, lens: Lens, scale: float, *, held_out: bool = False
) -> list[PosedImage]:
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
        listed.append(PosedImage(
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
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [_parse_numbers(line, f"{path}, line {at},", (16,))
            for at, line in enumerate(lines, 1) if line.strip()]


def _parse_numbers(text: str, where: str, sizes: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        numbers = np.array(text.split(), np.float64)
    except ValueError as error:
        raise FormatError(f"{where} holds something other than numbers.") from error
    if numbers.size not in sizes:
        raise FormatError(f"{where} has {numbers.size} numbers, needed 16 of a 4x4 matrix.")
    return numbers


def is_scannet(folder: Path) -> bool:
    """Returns whether a folder has the layout of ScanNet."""
    return (folder / "color").is_dir() and (folder / "pose").is_dir()


def read_scannet(folder: Path) -> PosedSet:
    """Returns a ScanNet scene without the frames whose tracking was lost.

    InputError if no frame has an image and a pose; FormatError if a file is missing or damaged.
    """
    colors = list_numbered(folder / "color", PICTURES)
    poses = list_numbered(folder / "pose", (".txt",))
    if not colors or not poses:
        raise InputError(
            f"{folder} has {len(colors)} images in color/ and {len(poses)} poses in pose/.",
            hint="Export both with ScanNet's SensReader.")
    lens = _read_lens(folder, "color", image_size(next(iter(colors.values()))))
    depths = list_numbered(folder / "depth", (".png",))
    own = _read_lens(folder, "depth", image_size(next(iter(depths.values())))) if depths else None
    listed, lost = [], 0
    for number, path in colors.items():
        viewmat = read_pose(poses[number]) if number in poses else None
        if viewmat is None:
            lost += 1
            continue
        depth = DepthFile(depths[number], MILLIMETRE, lens, own) if number in depths else None
        listed.append(PosedImage(path.name, path, lens, viewmat, depth=depth))
    return tracked_sequence("scannet", listed, folder, lost)


def tracked_sequence(
    layout: str, listed: Sequence[PosedImage], folder: Path, lost: int,
    notices: tuple[str, ...] = (),
) -> PosedSet:
    """Returns the frames of a metric sequence that have a pose; `lost` others have none.

    InputError if no frame has an image and a pose.
    """
    if not listed:
        raise InputError(
            f"{folder} has no frame with a pose: tracking was lost in all {lost}.",
            hint="Give the color images alone, so that `recon` finds the poses itself.")
    posed = find_images(layout, listed, folder)
    if lost:
        notices += (f"{lost} frames whose tracking was lost have no pose and are left out",)
    return replace(posed, metric=True, sequence=True, notices=notices + posed.notices)


def _read_lens(folder: Path, kind: str, size: tuple[int, int]) -> Lens:
    """Returns the intrinsics of the color or depth images, for whose size the file is written."""
    path = folder / "intrinsic" / f"intrinsic_{kind}.txt"
    if not path.is_file():
        raise FormatError(
            f"{path} is missing.", hint="Export it with ScanNet's SensReader --export_intrinsics.")
    lens = lens_from_matrix(read_matrix(path), *size, str(path))
    # It is within 2% of the middle, but at the border or beyond for images reduced after export.
    shares = [center / side for center, side in zip(lens.params[2:], size, strict=True)]
    if any(abs(share - 0.5) > 0.25 for share in shares):
        raise FormatError(
            f"{path} has the principal point {lens.params[2]:.0f}, {lens.params[3]:.0f}, but its "
            f"images have {size[0]}x{size[1]} pixels: it is for images of another size.",
            hint="Export the intrinsics for the size of the images.")
    return lens


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """Returns [4, 4] world to camera, None where tracking was lost."""
    matrix = read_matrix(path)
    return viewmat_from_pose(matrix, str(path)) if not np.isinf(matrix).any() else None


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Returns a 4x4 (or 3x3) matrix of text."""
    text = path.read_text(encoding="utf-8", errors="replace")
    values = _parse_numbers(text, str(path), (9, 16))
    side = 3 if values.size == 9 else 4
    return values.reshape(side, side)
