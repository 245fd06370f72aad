"""Whole COLMAP models of any camera model, binary or text, with or without rigs and frames.

Rigs and frames are read only if the images file is missing: images.bin and images.txt hold the
composed pose of each image (pycolmap 4.2). Observations and tracks are skipped. The layouts are
those of COLMAP's src/colmap/scene/reconstruction_io; errors in text name the line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.colmap import (
    Reader,
    model_error,
    pose_matrix,
    read_images,
    read_lenses,
    read_points,
)
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.paths import refuse_special

_SENSORS = {0: "CAMERA", 1: "IMU"}
_HINT = "Copy the model again, or export it again from COLMAP."
_TEXT_HINT = "Export the model again from COLMAP."
_COUNT = re.compile(r"# Number of \w+: (\d+)")
_HEAD = 5  # lines; COLMAP writes three or four comments

Pose = NDArray[np.float64]  # [4, 4]
Sensor = tuple[str, int]  # its type, such as CAMERA, and its id
NamedImage = tuple[str, int, Pose]  # name, camera id, world to camera
Rigs = dict[int, dict[Sensor, Pose]]  # sensor from rig, by rig id
Frames = list[tuple[int, Pose, list[tuple[Sensor, int]]]]  # rig id, rig from world, image ids


@dataclass(frozen=True, eq=False)
class Model:
    """A COLMAP model without its observations."""

    lenses: dict[int, Lens]  # intrinsics by camera id
    images: list[NamedImage]  # in the order of the file
    # camera id and world to camera by image id; empty unless the file with the names is missing
    unnamed: dict[int, tuple[int, Pose]]
    points: NDArray[np.float64]  # [P, 3] sparse points
    colors: NDArray[np.uint8]  # [P, 3] RGB of the points


def model_suffix(folder: Path) -> str | None:
    """Returns .bin or .txt for the form of the model in a folder, None if there is none."""
    for suffix in (".bin", ".txt"):
        if (folder / f"cameras{suffix}").is_file() and any(
                (folder / f"{name}{suffix}").is_file() for name in ("images", "frames")):
            return suffix
    return None


def count_images(folder: Path) -> int:
    """Returns how many images a model claims to have; 0 where that cannot be read."""
    suffix = model_suffix(folder)
    path = next((file for name in ("images", "frames")
                 if (file := folder / f"{name}{suffix}").is_file()), None)
    if path is None:
        return 0
    if suffix == ".bin":
        with path.open("rb") as stream:
            head = stream.read(8)
        return int.from_bytes(head, "little") if len(head) == 8 else 0
    if path.stem == "frames":
        return sum(1 for _ in _rows(path))
    return sum(_is_image(line) for _, line in _lines(path))


def read_model(folder: Path) -> Model:
    """Returns the model in a folder, the binary one if it has both forms."""
    suffix = model_suffix(folder)
    if suffix is None:
        raise FormatError(f"{folder} holds no COLMAP model.", hint=_HINT)
    binary = suffix == ".bin"
    cameras, images, points = (
        folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    lenses = read_lenses(cameras, hint=_HINT) if binary else _read_cameras_text(cameras)
    named: list[NamedImage] = []
    unnamed: dict[int, tuple[int, Pose]] = {}
    if images.is_file():
        named = read_images(images, hint=_HINT) if binary else _read_images_text(images)
    else:
        unnamed = _compose(folder, binary=binary)
    used = {camera for _, camera, _ in named} | {camera for camera, _ in unnamed.values()}
    if unknown := sorted(used - lenses.keys()):
        raise model_error(folder, f"images of the unknown camera {unknown[0]}", _HINT)
    if not used:
        raise model_error(folder, "no image has a pose", _HINT)
    positions, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if points.is_file():
        positions, colors = read_points(points, hint=_HINT) if binary else read_points_text(points)
    return Model(lenses, named, unnamed, positions, colors)


def _compose(folder: Path, *, binary: bool) -> dict[int, tuple[int, Pose]]:
    """Returns camera id and world to camera of each image id, from rigs and frames."""
    suffix = ".bin" if binary else ".txt"
    rigs_file, frames_file = folder / f"rigs{suffix}", folder / f"frames{suffix}"
    rigs = _read_rigs(rigs_file) if binary else _read_rigs_text(rigs_file)
    frames = _read_frames(frames_file) if binary else _read_frames_text(frames_file)
    poses = {}
    for rig_id, rig_from_world, data in frames:
        for sensor, image_id in data:
            if sensor[0] != "CAMERA":
                continue
            sensor_from_rig = rigs.get(rig_id, {}).get(sensor)
            if sensor_from_rig is None:
                raise model_error(
                    rigs_file, f"no pose of camera {sensor[1]} in rig {rig_id}", _HINT)
            poses[image_id] = sensor[1], sensor_from_rig @ rig_from_world
    return dict(sorted(poses.items()))


def _read_rigs(path: Path) -> Rigs:
    reader = Reader(path, _HINT)
    rigs = {}
    for _ in range(reader.count(minimum=8)):
        rig_id, count = reader.take("<II")
        sensors: dict[Sensor, Pose] = {}
        for index in range(count):
            kind, sensor_id = reader.take("<iI")
            sensor = _SENSORS.get(kind, str(kind)), sensor_id
            if index == 0:  # the origin of the rig
                sensors[sensor] = np.eye(4)
            elif reader.take("<B")[0]:
                sensors[sensor] = _take_pose(reader, path)
        rigs[rig_id] = sensors
    reader.end()
    return rigs


def _read_frames(path: Path) -> Frames:
    reader = Reader(path, _HINT)
    frames = []
    for _ in range(reader.count(minimum=68)):
        _, rig_id = reader.take("<II")
        pose = _take_pose(reader, path)
        data: list[tuple[Sensor, int]] = []
        for _ in range(reader.take("<I")[0]):
            kind, sensor_id, image_id = reader.take("<iIQ")
            data.append(((_SENSORS.get(kind, str(kind)), sensor_id), image_id))
        frames.append((rig_id, pose, data))
    reader.end()
    return frames


def _take_pose(reader: Reader, path: Path) -> Pose:
    matrix = pose_matrix(reader.take("<7d"))
    if matrix is None:
        raise model_error(path, "a pose that is not finite or has no rotation", _HINT)
    return matrix


def _read_cameras_text(path: Path) -> dict[int, Lens]:
    cameras = {}
    for where, words in _rows(path):
        camera_id, width, height = _integers([words[0], *words[2:4]], where, 3)
        params = _numbers(words[4:], where, len(words) - 4)
        cameras[camera_id] = make_lens(words[1], width, height, params, where)
    _check_complete(path, len(cameras))
    return cameras


def _read_images_text(path: Path) -> list[NamedImage]:
    images = []
    lines = _lines(path)
    observed = False  # this line may hold the observations of the image before
    for at, line in lines:
        if line.startswith("#"):
            continue
        if not line or (observed and not _is_image(line)):
            observed = False
            continue
        words = line.split(maxsplit=9)
        where = f"{path}, line {at},"
        if len(words) < 10:
            raise _line_error(where, f"{len(words)} entries, needed 10 of an image")
        (camera_id,) = _integers(words[8:9], where, 1)
        pose = _numbers(words[1:8], where, 7)
        images.append((words[9], camera_id, _parse_pose(pose, where)))
        observed = True  # empty, or left out by programs that write none
    _check_complete(path, len(images))
    return images


def _is_image(line: str) -> bool:
    """Returns whether a line is that of an image, and not of observations: x, y, id of each.

    Only a name of three words, all of them numbers, could be mistaken.
    """
    words = line.split()
    if len(words) < 10 or not all(map(_is_number, words[:9])):
        return False
    return len(words) % 3 != 0 or not all(map(_is_number, [*words[9:12], words[-1]]))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_points_text(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions [P, 3] and RGB colours [P, 3] of a points3D.txt, sorted by point id."""
    rows = []
    for where, words in _rows(path, max_words=8):
        row = _numbers(words[:7], where, 7)
        if not np.isfinite(row).all() or not all(0 <= value <= 255 for value in row[4:]):
            raise _line_error(where, "no finite position with a colour of 0 to 255")
        rows.append(row)
    _check_complete(path, len(rows))
    table = np.array(sorted(rows), np.float64).reshape(-1, 7)
    return np.ascontiguousarray(table[:, 1:4]), table[:, 4:].astype(np.uint8)


def _read_rigs_text(path: Path) -> Rigs:
    rigs = {}
    for where, words in _rows(path):
        rig_id, count = _integers(words[:2], where, 2)
        sensors = {}
        rest = words[2:]
        for index in range(count):
            sensor, rest = _parse_sensor(rest, where), rest[2:]
            has_pose = index > 0 and _integers(rest[:1], where, 1)[0] != 0
            rest = rest[1:] if index > 0 else rest  # the first sensor is the origin of the rig
            if has_pose:
                sensors[sensor] = _parse_pose(_numbers(rest[:7], where, 7), where)
                rest = rest[7:]
            elif index == 0:
                sensors[sensor] = np.eye(4)
        rigs[rig_id] = sensors
    return rigs


def _read_frames_text(path: Path) -> Frames:
    frames = []
    for where, words in _rows(path):
        _, rig_id = _integers(words[:2], where, 2)
        pose = _numbers(words[2:9], where, 7)
        (count,) = _integers(words[9:10], where, 1)
        rest = words[10:]
        if len(rest) != 3 * count:
            raise _line_error(where, f"{len(rest)} entries after its pose, needed {3 * count}")
        data = [(_parse_sensor(rest[at:], where), _integers(rest[at + 2:at + 3], where, 1)[0])
                for at in range(0, len(rest), 3)]
        frames.append((rig_id, _parse_pose(pose, where), data))
    return frames


def _lines(path: Path) -> list[tuple[int, str]]:
    refuse_special(path)
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError as error:
        raise FormatError(f"{path} is missing.", hint=_TEXT_HINT) from error
    return [(at, line.strip()) for at, line in enumerate(text.split("\n"), 1)]


def _check_complete(path: Path, count: int) -> None:
    """Raises FormatError if a file holds less than COLMAP's comment at its head promises."""
    for at, line in _lines(path)[:_HEAD]:
        promised = _COUNT.match(line)
        if promised and count < int(promised[1][:18]):
            raise _line_error(
                f"{path}", f"it ends after {count} of the {promised[1]} entries that line {at} "
                "promises")


def _rows(path: Path, *, max_words: int = -1) -> Iterator[tuple[str, list[str]]]:
    """Yields the position of each line for messages, and its words, at most `max_words` + 1."""
    for at, line in _lines(path):
        if line and not line.startswith("#"):
            yield f"{path}, line {at},", line.split(maxsplit=max_words)


def _numbers(words: Sequence[str], where: str, needed: int) -> list[float]:
    if len(words) < needed or needed < 0:
        raise _line_error(where, "it ends too soon")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise _line_error(where, "a word where a number belongs") from error


def _integers(words: Sequence[str], where: str, needed: int) -> list[int]:
    if len(words) < needed:
        raise _line_error(where, "it ends too soon")
    try:
        return [int(word) for word in words]
    except ValueError as error:
        raise _line_error(where, "a word where an integer belongs") from error


def _parse_sensor(words: Sequence[str], where: str) -> Sensor:
    return (words[0] if words else "", _integers(words[1:2], where, 1)[0])


def _parse_pose(numbers: Sequence[float], where: str) -> Pose:
    matrix = pose_matrix(numbers)
    if matrix is None:
        raise _line_error(where, "a pose that is not finite or has no rotation")
    return matrix


def _line_error(where: str, fault: str) -> FormatError:
    return FormatError(f"{where} is malformed: {fault}.", hint=_TEXT_HINT)
