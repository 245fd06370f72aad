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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.depth_file import MILLIMETRE, DepthFile
from recon_cli.datasets.frame_files import list_numbered, parse_numbers, read_rows
from recon_cli.datasets.frame_table import FrameTable, LeftOutError
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import lens_from_matrix, viewmat_from_pose
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_json

_TRAJ, _PARAMS = "traj.txt", "cam_params.json"


def is_replica(folder: Path) -> bool:
    """Returns whether a folder has the layout of Replica."""
    return (folder / _TRAJ).is_file() and (folder / "results").is_dir()


def read_replica(folder: Path) -> PosedSet:
    """Returns a Replica sequence, its test/ folder held out.

    InputError if there are no images; FormatError if a file is missing, damaged or does not fit.
    """
    lens, scale = _read_params(folder)
    table = FrameTable(folder, pictures=folder / "results")
    _add_sequence(table, folder, lens, scale)
    splits = (folder / "test" / "results").is_dir()
    if splits:
        _add_sequence(table, folder / "test", lens, scale, held_out=True)
    return replace(table.finish(), metric=True, sequence=True, splits=splits)


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


def _add_sequence(
    table: FrameTable, folder: Path, lens: Lens, scale: float, *, held_out: bool = False
) -> None:
    """Adds the frames of one results/ folder by number."""
    files = list_numbered(folder / "results", pattern="frame([0-9]+)")
    rows = read_rows(folder / _TRAJ)
    _check_count(folder, list(files), len(rows))
    prefix = "test_" if held_out else ""
    first = next(iter(files.values()))
    digits, suffix = len(first.stem) - len("frame"), first.suffix
    for number in range(max(files) + 1):
        path = files.get(number, folder / "results" / f"frame{number:0{digits}d}{suffix}")
        where, words = rows[number]
        viewmat = viewmat_from_pose(parse_numbers(words, where, 16), where)
        depth = path.with_name(path.stem.replace("frame", "depth") + ".png")
        table.add(PosedImage(
            prefix + path.name, path, lens, viewmat, held_out,
            DepthFile(depth, 1 / scale, lens) if depth.is_file() else None))


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


def is_scannet(folder: Path) -> bool:
    """Returns whether a folder has the layout of ScanNet."""
    return (folder / "color").is_dir() and (folder / "pose").is_dir()


def read_scannet(folder: Path) -> PosedSet:
    """Returns a ScanNet scene without the frames whose tracking was lost.

    InputError if no frame has an image and a pose; FormatError if a file is missing or damaged.
    """
    colors = list_numbered(folder / "color")
    poses = list_numbered(folder / "pose", (".txt",))
    if not colors or not poses:
        raise InputError(
            f"{folder} has {len(colors)} images in color/ and {len(poses)} poses in pose/.",
            hint="Export both with ScanNet's SensReader.")
    lens = _read_lens(folder, "color", image_size(next(iter(colors.values()))))
    depths = list_numbered(folder / "depth", (".png",))
    own = _read_lens(folder, "depth", image_size(next(iter(depths.values())))) if depths else None
    table = FrameTable(folder, pictures=folder / "color")
    for number, path in colors.items():
        with table.frame(path.name):
            viewmat = read_pose(poses.get(number))
            depth = DepthFile(depths[number], MILLIMETRE, lens, own) if number in depths else None
            table.add(PosedImage(path.name, path, lens, viewmat, depth=depth))
    return replace(table.finish(), metric=True, sequence=True)


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


def read_pose(path: Path | None) -> NDArray[np.float64]:
    """Returns [4, 4] world to camera; LeftOutError where tracking was lost."""
    matrix = np.array(np.inf) if path is None else read_matrix(path)
    if np.isinf(matrix).any():
        raise LeftOutError("whose tracking was lost")
    return viewmat_from_pose(matrix, str(path))


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Returns a 4x4 (or 3x3) matrix of text."""
    text = path.read_text(encoding="utf-8", errors="replace")
    values = parse_numbers(text.split(), str(path), 9, 16, finite=False)
    side = 3 if values.size == 9 else 4
    return values.reshape(side, side)
