"""COLMAP's text models, line by line: cameras.txt, images.txt, points3D.txt, rigs.txt, frames.txt.

Lines are named by their number in every error. Observations and tracks are skipped. The layout is
that of COLMAP's src/colmap/scene/reconstruction_io_text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.calibration import checked_lens
from recon_cli.io.colmap import rigid
from recon_cli.scene.camera import Lens

_HINT = "Export the model again from COLMAP."
_COUNT = re.compile(r"# Number of \w+: (\d+)")
_HEAD = 5  # lines; COLMAP writes three or four comments
Sensor = tuple[str, int]  # its type, such as CAMERA, and its id


def read_cameras_text(path: Path) -> dict[int, Lens]:
    """Returns the lenses of a cameras.txt by camera id.

    Raises:
        FormatError: the file is missing, a line is malformed, or a camera is of an unknown model.
    """
    cameras = {}
    for where, words in _rows(path):
        camera_id, width, height = _integers([words[0], *words[2:4]], where, 3)
        params = _numbers(words[4:], where, len(words) - 4)
        cameras[camera_id] = checked_lens(words[1], width, height, params, where)
    _check_complete(path, len(cameras))
    return cameras


def read_images_text(path: Path) -> list[tuple[str, int, NDArray[np.float64]]]:
    """Returns (name, camera id, [4, 4] world to camera) of each image of an images.txt.

    Raises:
        FormatError: the file is missing or a line is malformed.
    """
    images = []
    lines = iter(_lines(path))
    for at, line in lines:
        if not line or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        where = f"{path}, line {at},"
        if len(words) < 10:
            raise _malformed(where, f"{len(words)} entries, needed 10 of an image")
        (camera_id,) = _integers(words[8:9], where, 1)
        pose = _numbers(words[1:8], where, 7)
        images.append((words[9], camera_id, _pose(pose, where)))
        next(lines, None)  # its observations, which may be an empty line
    _check_complete(path, len(images))
    return images


def read_points_text(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions [P, 3] and RGB colours [P, 3] of a points3D.txt, sorted by point id.

    Raises:
        FormatError: the file is missing or a line is malformed.
    """
    rows = []
    for where, words in _rows(path, most=8):
        row = _numbers(words[:7], where, 7)
        if not np.isfinite(row).all() or not all(0 <= value <= 255 for value in row[4:]):
            raise _malformed(where, "no finite place with a colour of 0 to 255")
        rows.append(row)
    _check_complete(path, len(rows))
    table = np.array(sorted(rows), np.float64).reshape(-1, 7)
    return np.ascontiguousarray(table[:, 1:4]), table[:, 4:].astype(np.uint8)


def read_rigs_text(path: Path) -> dict[int, dict[Sensor, NDArray[np.float64]]]:
    """Returns [4, 4] sensor from rig of each sensor of each rig of a rigs.txt.

    Raises:
        FormatError: the file is missing or a line is malformed.
    """
    rigs = {}
    for where, words in _rows(path):
        rig_id, count = _integers(words[:2], where, 2)
        sensors = {}
        rest = words[2:]
        for index in range(count):
            sensor, rest = _sensor(rest, where), rest[2:]
            has_pose = index > 0 and _integers(rest[:1], where, 1)[0] != 0
            rest = rest[1:] if index > 0 else rest  # the first sensor is the origin of the rig
            if has_pose:
                sensors[sensor] = _pose(_numbers(rest[:7], where, 7), where)
                rest = rest[7:]
            elif index == 0:
                sensors[sensor] = np.eye(4)
        rigs[rig_id] = sensors
    return rigs


def read_frames_text(
    path: Path,
) -> list[tuple[int, NDArray[np.float64], list[tuple[Sensor, int]]]]:
    """Returns (rig id, [4, 4] rig from world, (sensor, image id) of its data) of each frame.

    Raises:
        FormatError: the file is missing or a line is malformed.
    """
    frames = []
    for where, words in _rows(path):
        _, rig_id = _integers(words[:2], where, 2)
        pose = _numbers(words[2:9], where, 7)
        (count,) = _integers(words[9:10], where, 1)
        rest = words[10:]
        if len(rest) != 3 * count:
            raise _malformed(where, f"{len(rest)} entries after its pose, needed {3 * count}")
        data = [(_sensor(rest[at:], where), _integers(rest[at + 2:at + 3], where, 1)[0])
                for at in range(0, len(rest), 3)]
        frames.append((rig_id, _pose(pose, where), data))
    return frames


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError as error:
        raise FormatError(f"{path} is missing.", hint=_HINT) from error
    return [(at, line.strip()) for at, line in enumerate(text.split("\n"), 1)]


def _check_complete(path: Path, found: int) -> None:
    """Raises FormatError when a file holds less than COLMAP's comment at its head promises."""
    for at, line in _lines(path)[:_HEAD]:
        promised = _COUNT.match(line)
        if promised and found < int(promised[1]):
            raise _malformed(
                f"{path}", f"it ends after {found} of the {promised[1]} entries that line {at} "
                "promises")


def _rows(path: Path, *, most: int = -1) -> Iterator[tuple[str, list[str]]]:
    """Yields where each line stands, and its words; of long lines only so many."""
    for at, line in _lines(path):
        if line and not line.startswith("#"):
            yield f"{path}, line {at},", line.split(maxsplit=most)


def _numbers(words: Sequence[str], where: str, needed: int) -> list[float]:
    if len(words) < needed or needed < 0:
        raise _malformed(where, "it ends too soon")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise _malformed(where, "a word where a number belongs") from error


def _integers(words: Sequence[str], where: str, needed: int) -> list[int]:
    if len(words) < needed:
        raise _malformed(where, "it ends too soon")
    try:
        return [int(word) for word in words]
    except ValueError as error:
        raise _malformed(where, "a word where a whole number belongs") from error


def _sensor(words: Sequence[str], where: str) -> Sensor:
    return (words[0] if words else "", _integers(words[1:2], where, 1)[0])


def _pose(numbers: Sequence[float], where: str) -> NDArray[np.float64]:
    matrix = rigid(numbers)
    if matrix is None:
        raise _malformed(where, "a pose that is not finite or has no rotation")
    return matrix


def _malformed(where: str, what: str) -> FormatError:
    return FormatError(f"{where} is malformed: {what}.", hint=_HINT)
