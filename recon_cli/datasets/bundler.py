"""Bundler: bundle.out with list.txt, as Bundler, VisualSFM and others write them.

A camera is f k1 k2, a rotation and a translation: world to camera, y up, looking along -z, pixels
from the middle of the image. Images are named by the lines of the list, in the order of the
cameras. f = 0 marks a camera that was not found. (Snavely, Bundler's manual, section 5.) The scale
is arbitrary.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.known_files import read_head
from recon_cli.datasets.exported_files import thin_cloud
from recon_cli.datasets.file_finder import FileFinder
from recon_cli.datasets.frame_files import parse_numbers
from recon_cli.datasets.frame_table import FrameTable, LeftOutError
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError
from recon_cli.scene.camera import make_lens
from recon_cli.workspace.atomic import read_text

_MARK = b"# Bundle file"
_LISTS = ("list.txt", "{stem}.list.txt", "{name}.list.txt", "../list.txt")
_FLIP = np.diag([1.0, -1.0, -1.0])  # from y up and looking along -z


def find_bundler(path: Path) -> Path | None:
    """Returns the Bundler file with its list in a folder, or that a file is."""
    files = [path] if path.is_file() else sorted([*path.glob("*.out"), *path.glob("*/bundle.out")])
    return next((file for file in files if file.suffix == ".out"
                 and read_head(file, len(_MARK)) == _MARK and _list_file(file) is not None), None)


def _list_file(file: Path) -> Path | None:
    return next((place for pattern in _LISTS if (place := file.parent / pattern.format(
        stem=file.stem, name=file.name)).is_file()), None)


def read_bundler(path: Path) -> PosedSet:
    """Returns the images of the cameras that were found, and the points.

    InputError if there is none; FormatError if a file is damaged, or the list of another one.
    """
    file = find_bundler(path)
    assert file is not None
    list_file = _list_file(file)
    assert list_file is not None
    folder = path if path.is_dir() else list_file.parent
    names = [line.split()[0] for line in _read(list_file).splitlines() if line.split()]
    lines = (line for line in _read(file).splitlines() if not line.startswith("#"))
    cameras, points = map(int, _take(lines, 2, file))
    if cameras != len(names):
        raise FormatError(
            f"{file} has {cameras} cameras, but {list_file.name} names {len(names)} images.",
            hint="Copy the list that belongs to it.")
    table = FrameTable(folder)
    finder = FileFinder(folder, names)
    for name in names:
        (focal, k1, k2), rows, shift = _take(lines, 3, file), [
            _take(lines, 3, file) for _ in range(3)], _take(lines, 3, file)
        with table.frame(PurePosixPath(name).name):
            if focal == 0:
                raise LeftOutError("that Bundler did not place")
            path = finder.find_photo(name)
            viewmat = table.pose(_camera_to_world, rows, shift)
            width, height = image_size(path)
            inner = [focal, width / 2, height / 2, *([k1, k2] if k1 or k2 else [])]
            lens = make_lens("RADIAL" if k1 or k2 else "SIMPLE_PINHOLE", width, height, inner,
                             f"{file}, {name},")
            table.add(PosedImage(path.name, path, lens, viewmat))
    posed = replace(table.finish(), find_up=True)
    cloud = [(_take(lines, 3, file), _take(lines, 3, file), next(lines, None))[:2]
             for _ in range(points)]  # the last of the three lines says who sees it
    return thin_cloud(posed, cloud)


def _read(file: Path) -> str:
    try:
        return read_text(file)
    except (OSError, ValueError) as error:
        raise FormatError(f"{file} cannot be read: {error}.") from error


def _take(lines: Iterator[str], count: int, file: Path) -> list[float]:
    """Returns the numbers of the next line."""
    line = next(lines, None)
    if line is None:
        raise FormatError(f"{file} is cut short.")
    return list(parse_numbers(line.split(), str(file), count, finite=False))


def _camera_to_world(rows: list[list[float]], shift: list[float]) -> NDArray[np.float64]:
    """Returns [3, 4] with OpenCV's camera axes."""
    rotation, moved = _FLIP @ np.array(rows), _FLIP @ np.array(shift)
    return np.column_stack([rotation.T, -rotation.T @ moved])
