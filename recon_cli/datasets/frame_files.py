"""What readers pair frames from: files by number or time, tables, and poses of phones."""

from __future__ import annotations

import csv
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.errors import FormatError
from recon_cli.workspace.atomic import read_text

PICTURES = (".jpg", ".jpeg", ".png")
HEAD_LINES = 3  # of a table, one of which is the header
_UNIT_LENGTH = 1e-2  # by which a quaternion of decimals may miss the length of 1
_OFF_CENTRE = 0.2  # of the image's side, by which a principal point may miss the middle
_RATIOS = sorted({a / b for a in range(1, 9) for b in range(1, 9)})  # of resized images
# Nearer to 1, a principal point that is off by one ratio along both sides may be a lens'.
_LEAST_RATIO = 1.25
_RATIO_SLACK = 0.06  # by which a principal point may miss the middle, as a share


def pose_from_quat(xyzw: Iterable[Any], position: Iterable[Any]) -> NDArray[np.float64]:
    """Returns [4, 4] of a unit quaternion x y z w and a position; ValueError if it is none."""
    quat = np.array([float(one) for one in xyzw])
    if not abs(np.linalg.norm(quat) - 1) < _UNIT_LENGTH:  # NaN too
        raise ValueError("not a unit quaternion")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quat).as_matrix()
    pose[:3, 3] = [float(one) for one in position]
    return pose


def pose_from_unity(xyzw: Iterable[Any], position: Iterable[Any]) -> NDArray[np.float64]:
    """Returns [4, 4] camera to world, OpenCV's axes, y up, of Unity's left-handed world and camera.

    ValueError as for `pose_from_quat`.
    """
    world, camera = np.diag([1.0, 1, -1, 1]), np.diag([1.0, -1, 1, 1])
    return np.asarray(world @ pose_from_quat(xyzw, position) @ camera)


def quoted(path: Path | str) -> str:
    """Returns a path as it is typed in a shell; text as it is."""
    return shlex.quote(str(path)) if isinstance(path, Path) else path


def list_numbered(
    folder: Path, suffixes: Sequence[str] = PICTURES, pattern: str = "([0-9]+)"
) -> dict[int, Path]:
    """Returns the files of a folder by their numbers, in order.

    `pattern` is of a name without its suffix. Copies such as `12(3).jpg` have no number; of 1.jpg
    and 0001.jpg the first by name counts.
    """
    return {int(number): path for number, path in _list_files(folder, suffixes, pattern)}


def list_timed(folder: Path, suffixes: Sequence[str] = PICTURES) -> dict[float, Path]:
    """Returns the files of a folder that are called <id>_<seconds>, in order of time."""
    return dict(_list_files(folder, suffixes, r"(?:.*_)?([0-9]+\.?[0-9]*|\.[0-9]+)"))


def _list_files(
    folder: Path, suffixes: Sequence[str], pattern: str
) -> list[tuple[float, Path]]:
    files: dict[float, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = re.fullmatch(pattern, path.stem, re.IGNORECASE)
        if match and path.suffix.lower() in suffixes:
            files.setdefault(float(match[1]), path)
    return sorted(files.items())


def list_reduced(folder: Path) -> list[Path]:
    """Returns images_2, images_4 and so on, the largest images first."""
    folders = [path for path in folder.glob("images_*") if path.name[7:].isdecimal()]
    return sorted(folders, key=lambda path: int(path.name[7:]))


def read_rows(path: Path) -> list[tuple[str, list[str]]]:
    """Returns the place and the words of each line that is neither empty nor a comment.

    FormatError if the file is missing.
    """
    if not path.is_file():
        raise FormatError(f"{path} is missing.")
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [(f"{path}, line {at},", line.split()) for at, line in enumerate(lines, 1)
            if line.strip() and line.strip()[0] != "#"]


def parse_numbers(
    words: Sequence[str], where: str, *counts: int, finite: bool = True
) -> NDArray[np.float64]:
    """Returns numbers of text; FormatError if they are not as many as one of the counts."""
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise FormatError(
            f"{where} holds {' '.join(words)[:40]!r}, something other than numbers.") from error
    if values.size not in counts:
        raise FormatError(f"{where} has {values.size} numbers, needed {counts[-1]}.")
    if finite and not np.isfinite(values).all():
        raise FormatError(f"{where} holds a number that is not finite.")
    return values


def read_csv(path: Path, needed: Sequence[str]) -> list[dict[str, str]]:
    """Returns the rows of a table with a header, by its names in small letters.

    Comments may stand above the header. A line that is cut short lacks its last columns.
    FormatError if a needed column is missing.
    """
    try:
        lines = [line for line in read_text(path).lstrip("\ufeff").splitlines() if line.strip()]
        table = [[value.strip() for value in row]
                 for row in csv.reader(lines, skipinitialspace=True)]
    except (OSError, ValueError, csv.Error) as error:
        raise FormatError(
            f"{path} cannot be read: {error}.", hint="Copy the file again.") from error
    heads = [column_names(row) for row in table[:HEAD_LINES]]
    at = next((at for at, names in enumerate(heads) if set(needed) <= set(names)), None)
    if at is None:
        names = heads[0] if heads else []
        missing = [name for name in needed if name not in names]
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(names) or 'none'}.",
            hint="Copy the file again, or export it again.")
    return [dict(zip(heads[at], row, strict=False)) for row in table[at + 1:]]


def column_names(row: Sequence[str]) -> list[str]:
    """Returns the names of the columns of a header, in small letters and without its mark."""
    return [name.strip().lstrip("#").strip().lower() for name in row]


def numbers(row: Mapping[str, str], names: Sequence[str]) -> list[float]:
    """Returns numbers of a row; KeyError or ValueError where one is missing."""
    return [float(row[name]) for name in names]


def find_number(values: Mapping[str, Any], key: str) -> float | None:
    """Returns the number under a key, None where there is none."""
    try:
        return float(values[key])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def fit_intrinsics(
    params: Sequence[float], size: tuple[int, int], where: str
) -> tuple[tuple[float, float, float, float], float]:
    """Returns fx, fy, cx, cy for images of a size, and by which factor they were scaled.

    If the principal point lies off the middle by one simple factor along both sides, they are those
    of a larger or smaller image. FormatError if they are those of no such size.
    """
    fx, fy, cx, cy = map(float, params)
    width, height = size
    if not all(np.isfinite([fx, fy, cx, cy])) or min(fx, fy, cx, cy) <= 0:
        raise FormatError(f"{where} holds no intrinsics of a camera: {fx:g} {fy:g} {cx:g} {cy:g}.")
    across, down = width / (2 * cx), height / (2 * cy)
    ratio = min(_RATIOS, key=lambda one: abs(np.log(one / np.sqrt(across * down))))
    fits = max(abs(across / ratio - 1), abs(down / ratio - 1)) <= _RATIO_SLACK
    if fits and max(ratio, 1 / ratio) >= _LEAST_RATIO:
        return (fx * ratio, fy * ratio, cx * ratio, cy * ratio), float(ratio)
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _OFF_CENTRE:
        raise FormatError(
            f"{where} has the principal point {cx:.0f}, {cy:.0f}, but the images have "
            f"{width}x{height} pixels: it is that of images of another shape.",
            hint="Export images and intrinsics at one size.")
    return (fx, fy, cx, cy), 1.0
