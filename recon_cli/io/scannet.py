"""ScanNet scenes as its exporters write them, one file a frame.

color/<n>.jpg, depth/<n>.png in millimetres, pose/<n>.txt with a camera-to-world matrix (OpenCV
axes, metres; -inf where tracking was lost), intrinsic/intrinsic_color.txt and intrinsic_depth.txt.
ScanNet unprojects whole pixel indices (sensorData.h), so its pixel centres lie at whole numbers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import lens_from_matrix, viewmat_from_pose
from recon_cli.io.posed import DepthFile, ListedImage, PosedSet, find_images, image_size
from recon_cli.scene.camera import Lens

_MILLIMETRE = 1e-3  # ScanNet's depth shift is 1000
_COLORS = (".jpg", ".jpeg", ".png")


def is_scannet(folder: Path) -> bool:
    """Returns whether a folder has the layout."""
    return (folder / "color").is_dir() and (folder / "pose").is_dir()


def read_scannet(folder: Path) -> PosedSet:
    """Returns a ScanNet scene without the frames whose tracking was lost.

    Raises:
        InputError: no frame has an image and a pose.
        FormatError: a pose or the intrinsics are missing or damaged.
    """
    colors = _list_numbered(folder / "color", _COLORS)
    poses = _list_numbered(folder / "pose", (".txt",))
    if not colors or not poses:
        raise InputError(
            f"{folder} has {len(colors)} images in color/ and {len(poses)} poses in pose/.",
            hint="Export both with ScanNet's SensReader.")
    lens = _read_lens(folder, "color", image_size(next(iter(colors.values()))))
    depths = _list_numbered(folder / "depth", (".png",))
    own = _read_lens(folder, "depth", image_size(next(iter(depths.values())))) if depths else None
    listed, lost = [], 0
    for number, path in colors.items():
        viewmat = _read_pose(poses[number]) if number in poses else None
        if viewmat is None:
            lost += 1
            continue
        depth = (DepthFile(depths[number], _MILLIMETRE, lens, own) if number in depths else None)
        listed.append(ListedImage(path.name, path, lens, viewmat, depth=depth))
    if not listed:
        raise InputError(
            f"{folder} has no frame with a pose: tracking was lost in all {len(colors)}.",
            hint="Give the photos alone (color/), so that `recon` finds the poses itself.")
    posed = find_images("scannet", listed, folder)
    notices = (f"{lost} frames whose tracking was lost have no pose and are left out",) * bool(lost)
    return replace(posed, metric=True, sequence=True, notices=notices + posed.notices)


def _list_numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Returns the files that are named by a number, in its order."""
    if not folder.is_dir():
        return {}
    files = [path for path in folder.iterdir()
             if path.suffix.lower() in suffixes and path.stem.isdecimal()]
    return {int(path.stem): path for path in sorted(files, key=lambda path: int(path.stem))}


def _read_lens(folder: Path, kind: str, size: tuple[int, int]) -> Lens:
    """Returns the intrinsics of the color or depth images, which are of the given size.

    The file does not say for which size it is; the exporters write it for the size of the images.
    """
    path = folder / "intrinsic" / f"intrinsic_{kind}.txt"
    if not path.is_file():
        raise FormatError(
            f"{path} is missing.", hint="Export it with ScanNet's SensReader --export_intrinsics.")
    lens = lens_from_matrix(_read_numbers(path), *size, str(path), first_center=0)
    # ScanNet's cameras have it within 2% of the middle; images reduced after the export to half
    # their size or less have it at the border or beyond.
    shares = [center / side for center, side in zip(lens.params[2:], size, strict=True)]
    if any(abs(share - 0.5) > 0.25 for share in shares):
        raise FormatError(
            f"{path} has the principal point {lens.params[2]:.0f}, {lens.params[3]:.0f}, but its "
            f"images have {size[0]}x{size[1]} pixels: it is for images of another size.",
            hint="Export the intrinsics for the size of the images.")
    return lens


def _read_pose(path: Path) -> NDArray[np.float64] | None:
    """Returns [4, 4] world to camera, None where tracking was lost."""
    matrix = _read_numbers(path)
    return viewmat_from_pose(matrix, str(path)) if not np.isinf(matrix).any() else None


def _read_numbers(path: Path) -> NDArray[np.float64]:
    """Returns a 4x4 (or 3x3) matrix of text."""
    words = path.read_text(encoding="utf-8", errors="replace").split()
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise FormatError(f"{path} holds something other than numbers.") from error
    if values.size not in (9, 16):
        raise FormatError(f"{path} has {values.size} numbers, needed the 16 of a 4x4 matrix.")
    side = 3 if values.size == 9 else 4
    return values.reshape(side, side)
