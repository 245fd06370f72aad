"""LLFF scenes: images/ and poses_bounds.npy.

A row holds a 3x5 matrix row by row and two bounds of depth. Its columns are the camera's axes down,
right and back in the world, its position, and height, width and focal length in pixels. Rows are in
the order of the images' names. (Fyusion/LLFF, README: "Using your own poses".) The scale is
arbitrary.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.frame_files import list_reduced
from recon_cli.datasets.frame_table import FrameTable, LeftOutError
from recon_cli.datasets.posed import SUFFIXES, PosedImage, PosedSet
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.camera import make_lens

_FILE = "poses_bounds.npy"
_PLACES = ("images", "input", "rgb")


def is_llff(folder: Path) -> bool:
    """Returns whether a folder is a scene of LLFF."""
    return (folder / _FILE).is_file()


def read_llff(folder: Path) -> PosedSet:
    """Returns the images in the order of their names.

    InputError if there are none; FormatError if the poses are damaged or not one for each image.
    """
    rows, home = _read_rows(folder / _FILE), _choose_images(folder, 0)
    images = _list_images(home)
    if len(images) != len(rows):
        home = _choose_images(folder, len(rows))
        images = _list_images(home)
    if len(images) != len(rows):
        raise FormatError(
            f"{folder / _FILE} has {len(rows)} poses, but {home.name}/ {len(images)} images: "
            "nothing says which belong together.",
            hint="Copy all images of the scene; poses and names have one order.")
    table = FrameTable(folder, pictures=home)
    for at, (row, path) in enumerate(zip(rows, images, strict=True)):
        with table.frame(path.name):
            viewmat = table.pose(_pose, row)
            height, width, focal = row[:, 4]
            try:
                lens = make_lens("PINHOLE", width, height, (focal, focal, width / 2, height / 2),
                                 f"{folder / _FILE}, row {at},")
            except FormatError as error:
                raise LeftOutError("whose intrinsics cannot be used") from error
            table.add(PosedImage(path.name, path, lens, viewmat))
    return table.finish()


def _read_rows(path: Path) -> NDArray[np.float64]:
    """Returns [N, 3, 5]."""
    try:
        values = np.array(np.load(path, mmap_mode="r"))  # refuses a shape that the file lacks
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    # with the bounds, and without
    if values.ndim != 2 or values.shape[1] not in (17, 15) or values.dtype.kind not in "fiu":
        raise FormatError(
            f"{path} holds {values.dtype} of shape {values.shape}; needed are 17 numbers a row.")
    return values[:, :15].astype(np.float64).reshape(-1, 3, 5)


def _pose(row: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns camera to world [3, 4], OpenCV's axes: right, down, ahead."""
    down, right, back, position = row[:, 0], row[:, 1], row[:, 2], row[:, 3]
    return np.stack([right, down, -back, position], axis=1)


def _choose_images(folder: Path, count: int) -> Path:
    """Returns the folder of the images; with a count, the one that has so many, if there is."""
    places = [place for place in (
        *(folder / name for name in _PLACES), *list_reduced(folder), folder)
        if place.is_dir() and _list_images(place)]
    if not places:
        raise InputError(f"{folder} holds {_FILE}, but no images.",
                         hint=f"Put the images into {folder / 'images'}.")
    return next((place for place in places if len(_list_images(place)) == count), places[0])


def _list_images(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir()
                  if path.suffix in SUFFIXES and path.is_file() and path.name[0] != ".")
