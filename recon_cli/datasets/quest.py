"""Meta Quest 3: colour and poses of QuestRealityCapture's MRUK recordings.

session_info.json names the backend. {left,right}_camera_mruk_rgba/<us>.rgba hold R G B A, bottom
row first; _intrinsics.json the lens, and _frame_metadata.csv a pose for each file in Unity's axes
(left-handed, y up, metres, camera to world). Rows whose pose, texture or colours failed are left
out. (t-34400/QuestRealityCapture: MrukCameraRecorder.cs.)
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.frame_files import (
    find_number,
    fit_intrinsics,
    numbers,
    pose_from_unity,
    quoted,
    read_csv,
)
from recon_cli.datasets.frame_table import FrameTable, LeftOutError
from recon_cli.datasets.posed import PosedImage, PosedSet, is_file, resolve_inside
from recon_cli.datasets.quest_depth import depth_of_photo, find_order, list_depth
from recon_cli.errors import FormatError, InputError, format_count
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_json

_EYES = ("left", "right")
_OK = ("pose_ok", "get_texture_ok", "get_colors_ok")
_POSITION, _TURN = "pose_pos_{}", "pose_rot_{}"
_ASKED = 60  # frames that the order of depth is found from
_HINT = "Copy the recording from the headset again."


def is_quest(folder: Path) -> bool:
    """Returns whether a folder is a recording of the MRUK backend."""
    return any((folder / f"{eye}_camera_mruk_rgba").is_dir()
               and (folder / f"{eye}_camera_mruk_frame_metadata.csv").is_file() for eye in _EYES)


def read_quest(folder: Path) -> PosedSet:
    """Returns the frames of both cameras; InputError if none has an image and a pose."""
    table = FrameTable(folder, pictures=(
        f"{quoted(folder)}, once its .rgba files are converted to pictures"))
    for eye in _EYES:
        if (folder / f"{eye}_camera_mruk_frame_metadata.csv").is_file():
            _add_eye(table, folder, eye)
    # Both cameras of a moment after each other, so that neighbours by name are so in time.
    table.rows.sort(key=lambda image: (image.path.stem, image.name))
    if any(folder.glob("*_depth/*.raw")):
        _add_depth(table, folder)
    return table.finish_tracked()


def _add_depth(table: FrameTable, folder: Path) -> None:
    """Adds depth, where the order of its rows shows, and a notice of frames without."""
    for eye in _EYES:
        frames = list_depth(folder, eye, table)
        order = find_order(frames[::max(1, len(frames) // _ASKED)])
        if order is not None:
            table.rows = [replace(image, depth=depth_of_photo(
                frames, order, image.clock_ms, image.lens, image.viewmat))
                if image.clock_ms is not None and image.name.endswith(f"_{eye}.rgba") else image
                for image in table.rows]
    unread = sum(image.depth is None for image in table.rows)
    if unread:
        table.notices.append(
            f"depth is not read of {format_count(unread, 'frame')}: none is near in time, or the "
            "order of its rows, which is not documented, does not show in it")


def _add_eye(table: FrameTable, folder: Path, eye: str) -> None:
    """Adds the frames of one camera."""
    home = folder / f"{eye}_camera_mruk_rgba"
    metadata = folder / f"{eye}_camera_mruk_frame_metadata.csv"
    columns = [_POSITION.format(axis) for axis in "xyz"], [_TURN.format(axis) for axis in "xyzw"]
    rows = read_csv(metadata, ["file_name", *columns[0], *columns[1]])
    lens = _read_lens(folder / f"{eye}_camera_mruk_intrinsics.json")
    for row in rows:
        with table.frame(f"{eye} {row.get('file_name', '?')}"):
            if any(row.get(key, "true").lower() in ("false", "0") for key in _OK):
                raise LeftOutError("that the headset says failed")
            path = _find_file(home, row.get("file_name", ""), metadata)
            own = _own_lens(lens, row)
            if path.stat().st_size != own.width * own.height * 4:
                raise LeftOutError(
                    f"whose .rgba file does not hold {own.width}x{own.height} pixels")
            viewmat = table.pose(_pose, row, columns)
            time = find_number(row, "timestamp_us_realtime")
            table.add(PosedImage(
                f"{path.stem}_{eye}.rgba", path, own, viewmat, time=time and time / 1e6,
                clock_ms=find_number(row, "unix_time_ms"),
                read=functools.partial(read_rgba, path, own.width, own.height)))


def _find_file(home: Path, name: str, metadata: Path) -> Path:
    """Returns the file of a row, with or without its suffix."""
    with suppress(FormatError):
        path = resolve_inside(home, Path(name).name, str(metadata))
        named = path if path.suffix == ".rgba" else path.with_name(f"{path.name}.rgba")
        if is_file(named):
            return named
    raise LeftOutError("whose .rgba file is missing")


def _pose(row: Mapping[str, str], columns: tuple[list[str], list[str]]) -> NDArray[np.float64]:
    return pose_from_unity(numbers(row, columns[1]), numbers(row, columns[0]))


def _read_lens(path: Path) -> Lens:
    value: Mapping[str, Any] = read_json(path, dict)
    try:
        focal, center, size = value["focalLength"], value["principalPoint"], value["resolution"]
        params = [float(pair[axis]) for pair in (focal, center) for axis in "xy"]
        lens = make_lens("PINHOLE", float(size["width"]), float(size["height"]), params, str(path))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} lacks focalLength, principalPoint or resolution.") from error
    _, factor = fit_intrinsics(lens.params, (lens.width, lens.height), str(path))
    if factor != 1:
        raise FormatError(
            f"{path} has the principal point {params[2]:.0f}, {params[3]:.0f}, but the resolution "
            f"{lens.width}x{lens.height}: they are those of different sizes.")
    return lens


def _own_lens(lens: Lens, row: Mapping[str, str]) -> Lens:
    """Returns the lens at the size of a row's picture; FormatError if it has another shape."""
    try:
        width, height = int(row["width"]), int(row["height"])
    except (KeyError, ValueError):
        return lens
    if min(width, height) < 1 or abs(width * lens.height - height * lens.width) > max(
            width, height, lens.width, lens.height):
        raise FormatError(
            f"The intrinsics are for {lens.width}x{lens.height} pixels, but pictures have "
            f"{width}x{height}.")
    return lens.resized(width, height)


def read_rgba(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Returns RGB [H, W, 3] of a file of R G B A, bottom row first; InputError if damaged."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}.", hint=_HINT) from error
    if data.size != width * height * 4:
        raise InputError(f"{path} does not hold {width}x{height} pixels.", hint=_HINT)
    return np.ascontiguousarray(data.reshape(height, width, 4)[::-1, :, :3])
