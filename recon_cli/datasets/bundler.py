"""Bundler: bundle.out with list.txt, as Bundler, VisualSFM and others write them.

A camera is f k1 k2, a rotation and a translation: world to camera, y up, looking along -z, pixels
from the middle of the image. Images are named by the lines of the list, in the order of the
cameras. f = 0 marks a camera that was not found. (Snavely, Bundler's manual, section 5.) The scale
is arbitrary.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.app_frames import LeftOut, quoted
from recon_cli.datasets.depth_points import MAX_POINTS, thin_points
from recon_cli.datasets.exported_files import PhotoFiles, solved_set
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError
from recon_cli.scene.camera import make_lens
from recon_cli.workspace.atomic import read_text

_MARK = b"# Bundle file"
_LISTS = ("list.txt", "{stem}.list.txt", "{name}.list.txt", "../list.txt")
_HINT = "Copy the file again; Bundler's format is that of version 0.3."
_FLIP = np.diag([1.0, -1.0, -1.0])  # from y up and looking along -z


def is_bundler(path: Path) -> bool:
    """Returns whether a folder has a Bundler file with its list, or a file is one."""
    return _find(path) is not None


def _find(path: Path) -> Path | None:
    files = [path] if path.is_file() else sorted([*path.glob("*.out"), *path.glob("*/bundle.out")])
    for file in files:
        if file.suffix == ".out" and file.is_file():
            with file.open("rb") as stream:
                if stream.read(len(_MARK)) == _MARK and _list_file(file) is not None:
                    return file
    return None


def _list_file(file: Path) -> Path | None:
    return next((place for pattern in _LISTS if (place := file.parent / pattern.format(
        stem=file.stem, name=file.name)).is_file()), None)


def read_bundler(path: Path) -> PosedSet:
    """Returns the images of the cameras that were found, and the points.

    InputError if there is none; FormatError if a file is damaged, or the list of another one.
    """
    file = _find(path)
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
    left_out, listed = LeftOut(), []
    files = PhotoFiles(folder, names, left_out)
    for name in names:
        (focal, k1, k2), rows, shift = _take(lines, 3, file), [
            _take(lines, 3, file) for _ in range(3)], _take(lines, 3, file)
        image = None if focal == 0 else files.find(name)
        if focal == 0:
            left_out.add(name, "that Bundler did not place")
        elif image is not None:
            pose = left_out.pose(image.name, _camera_to_world, rows, shift, opengl=False)
            if pose is not None:
                width, height = image_size(image)
                lens = make_lens("RADIAL", width, height,
                                 (focal, width / 2, height / 2, k1, k2), f"{file}, {name},")
                if not k1 and not k2:
                    lens = make_lens("SIMPLE_PINHOLE", width, height, lens.params[:3], str(file))
                listed.append(PosedImage(image.name, image, lens, pose))
    posed = solved_set("bundler", listed, folder, left_out, missing=files.missing,
                       photos=quoted(folder))
    cloud, colors = _read_points(lines, points, file)
    posed = replace(posed, find_up=True)
    return replace(posed, points=cloud, colors=colors) if len(cloud) else posed


def _read(file: Path) -> str:
    try:
        return read_text(file)
    except (OSError, ValueError) as error:
        raise FormatError(f"{file} cannot be read: {error}.", hint=_HINT) from error


def _take(lines: Iterator[str], count: int, file: Path) -> list[float]:
    """Returns the numbers of the next line."""
    line = next(lines, None)
    if line is None:
        raise FormatError(f"{file} is cut short.", hint=_HINT)
    try:
        values = list(map(float, line.split()))
    except ValueError as error:
        raise FormatError(f"{file} has {line[:40]!r} where {count} numbers belong.",
                          hint=_HINT) from error
    if len(values) != count:
        raise FormatError(f"{file} has {line[:40]!r} where {count} numbers belong.", hint=_HINT)
    return values


def _camera_to_world(rows: list[list[float]], shift: list[float]) -> NDArray[np.float64]:
    """Returns [3, 4] with OpenCV's camera axes."""
    rotation, moved = _FLIP @ np.array(rows), _FLIP @ np.array(shift)
    return np.column_stack([rotation.T, -rotation.T @ moved])


def _read_points(
    lines: Iterator[str], count: int, file: Path
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    points, colors = [], []
    for _ in range(count):
        points.append(_take(lines, 3, file))
        colors.append(_take(lines, 3, file))
        next(lines, None)  # who sees it
    cloud, rgb = np.array(points).reshape(-1, 3), np.array(colors).reshape(-1, 3)
    good = np.isfinite(cloud).all(axis=1) & np.isfinite(rgb).all(axis=1)
    cloud, rgb = cloud[good], rgb[good]
    rows = thin_points(cloud, MAX_POINTS)
    return cloud[rows], rgb[rows].clip(0, 255).astype(np.uint8)
