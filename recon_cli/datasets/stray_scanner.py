"""Stray Scanner: rgb.mp4 with odometry.csv, camera_matrix.csv, depth/ and confidence/.

Frame n of the video belongs to the row and to the files of depth that are numbered n, whatever the
times say. Poses are camera to world with OpenCV's axes, in ARKit's world: metres, y up. Since April
2026 each row has its own intrinsics; camera_matrix.csv holds those of the last frame. Depth and
confidence are PNGs, in millimetres and as 0, 1, 2. (strayrobots/scanner, docs/format.md, issues 11
and 17.) Accelerations of imu.csv say whether y is up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.video import open_video, read_declared_length
from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.frame_files import (
    find_number,
    fit_intrinsics,
    list_numbered,
    numbers,
    pose_from_quat,
    read_csv,
)
from recon_cli.datasets.frame_table import Y_UP, FrameTable, LeftOutError
from recon_cli.datasets.phone_gravity import read_gravity
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.gravity import MAX_UP_SPREAD_DEG
from recon_cli.scene.statistics import at_least

_VIDEO, _ODOMETRY, _MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_IMU = "imu.csv"
# By which rows and frames of a whole recording differ: at least, and of all.
_SPARE_ROWS = (3, 0.02)
_INNER = ("fx", "fy", "cx", "cy")


def is_stray(folder: Path) -> bool:
    """Returns whether a folder is a recording of Stray Scanner."""
    return (folder / _VIDEO).is_file() and (folder / _ODOMETRY).is_file()


def read_stray(folder: Path) -> PosedSet:
    """Returns the frames of the video that have a row.

    InputError if none has a pose; FormatError if the video or a list is damaged.
    """
    video = folder / _VIDEO
    rows = read_csv(folder / _ODOMETRY, ("frame", *_POSE))
    size, count = _measure(video)
    table = FrameTable(folder, pictures=video)
    inner = _read_matrix(folder / _MATRIX, size, rows, table)
    depths = list_numbered(folder / "depth", (".png", ".npy"))  # .npy: old versions
    levels = list_numbered(folder / "confidence", (".png",))
    seen = set[int]()
    for row in rows:
        with table.frame(f"frame {row.get('frame', '?')}"):
            if not row.get("frame", "").isdecimal() or int(row["frame"]) in seen:
                raise LeftOutError("whose number is missing or repeated")
            number = int(row["frame"])
            seen.add(number)
            if count and number >= count:
                raise LeftOutError(f"beyond the {count} of the video")
            viewmat = table.pose(_pose, row)
            lens = table.lens(size, _intrinsics, row, inner)
            table.add(PosedImage(
                f"{number:06d}.png", video, lens, viewmat, frame=number,
                time=find_number(row, "timestamp"),
                depth=lidar_depth(depths.get(number), levels.get(number), lens)))
    table.rows.sort(key=lambda image: image.name)
    if count and abs(count - len(rows)) > at_least(_SPARE_ROWS, count):
        table.notices.append(f"the video has {count} frames, but {_ODOMETRY} {len(rows)} rows: one "
                             "of them is cut short, or of another recording")
    return _check_up(table.finish_tracked(), folder / _IMU)


def _check_up(posed: PosedSet, imu: Path) -> PosedSet:
    """Returns the set with up by its accelerations where these are sure that y is not."""
    timed = [image for image in posed.images if image.time is not None]
    if not (imu.is_file() and timed):
        return posed  # older recordings have none
    try:
        gravity = read_gravity(imu, [image.time or 0.0 for image in timed],
                               np.stack([image.viewmat for image in timed]))
    except FormatError as error:
        return replace(posed, notices=(*posed.notices, f"{imu.name} is not read: {error.message}"))
    if gravity is None or not gravity.is_sure:
        return posed
    off = float(np.degrees(np.arccos(np.clip(gravity.up @ np.array(Y_UP), -1, 1))))
    if off <= MAX_UP_SPREAD_DEG:  # ARKit's y is good to about one degree
        return posed
    x, y, z = gravity.up
    return replace(posed, up=(float(x), float(y), float(z)), notices=(*posed.notices, (
        f"up is taken from {imu.name}: it is {off:.0f} degrees off the y axis of the poses")))


def _measure(video: Path) -> tuple[tuple[int, int], int]:
    """Returns width and height as stored, and the number of frames, 0 if it is not known."""
    try:
        with open_video(video) as (_, stream):
            size = stream.codec_context.width, stream.codec_context.height
        return size, read_declared_length(video).frames
    except InputError as error:
        raise FormatError(error.message) from error


def _read_matrix(
    path: Path, size: tuple[int, int], rows: Sequence[Mapping[str, str]], table: FrameTable
) -> Sequence[float] | None:
    """Returns fx, fy, cx, cy for frames without their own, None if there is none such."""
    if not path.is_file():
        if any(not row.get("fx") for row in rows):
            raise FormatError(
                f"{path} is missing, and {_ODOMETRY} has no intrinsics of each frame.")
        return None
    text = path.read_text(encoding="utf-8", errors="replace").replace(",", " ").split()
    try:
        fx, _, cx, _, fy, cy, _, _, one = (float(number) for number in text)
        if one != 1:
            raise ValueError("another matrix")
    except ValueError as error:
        raise FormatError(
            f"{path} does not hold the 9 numbers of a matrix of intrinsics.") from error
    inner, factor = fit_intrinsics((fx, fy, cx, cy), size, str(path))
    if factor != 1:
        table.notices.append(f"its intrinsics were scaled by {factor:.4g}: those of {path.name} "
                             "are for images of another size")
    return inner


def _pose(row: Mapping[str, str]) -> NDArray[np.float64]:
    return pose_from_quat(numbers(row, _POSE[3:]), numbers(row, _POSE[:3]))


def _intrinsics(row: Mapping[str, str], inner: Sequence[float] | None) -> Sequence[float]:
    """Returns fx, fy, cx, cy of a frame: its own, else those of the last one."""
    if all(row.get(key) for key in _INNER):
        return numbers(row, _INNER)
    if inner is None:
        raise KeyError("no intrinsics")
    return inner
