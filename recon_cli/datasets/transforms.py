"""transforms.json of nerfstudio and instant-ngp; transforms_train/val/test.json of NeRF's scenes.

Poses are camera to world with OpenGL axes (x right, y up, looking along -z), converted from and to
world to camera with OpenCV axes; the world stays as it is. Intrinsics are in pixels with the centre
of the first one at 0.5. nerfstudio's applied_transform was applied to poses and points alike and is
not undone.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.datasets.depth_file import LIDAR_RANGE, MILLIMETRE, DepthFile
from recon_cli.datasets.exported_files import read_cloud
from recon_cli.datasets.file_finder import FileFinder
from recon_cli.datasets.frame_files import find_number
from recon_cli.datasets.frame_table import FrameTable
from recon_cli.datasets.posed import (
    PosedImage,
    PosedSet,
    image_size,
    is_file,
    resolve_inside,
)
from recon_cli.datasets.split_lists import PARTS, match_parts, split_parts
from recon_cli.errors import FormatError, Hint, InputError, format_count
from recon_cli.io.calibration import pose_from_viewmat, viewmat_from_pose
from recon_cli.scene.camera import Camera, Lens, make_lens
from recon_cli.workspace.atomic import read_json, write_json

_FISHEYE = ("OPENCV_FISHEYE",)
# They share one meaning of k1, k2, p1, p2, and leave at zero what they do not have.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # COLMAP's order in FULL_OPENCV
_LARGEST = sys.float_info.max
_FILE = "transforms.json"
_HINT = "Export it again from the program that it came from."


def read_lens(entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Lens:
    """Returns the lens of a frame.

    `entry` has the keys of the frame over those of the file; `size` is (width, height), for where w
    and h are not given. FormatError if the focal length is missing or an entry cannot be used.
    """
    width = read_number(entry, "w", where) or float(size[0])
    height = read_number(entry, "h", where) or float(size[1])
    fx = _focal(entry, "x", width, where)
    fy = _focal(entry, "y", height, where)
    if fx is None and fy is None:
        raise FormatError(
            f"{where} has no focal length: neither fl_x nor camera_angle_x.",
            hint="Add fl_x, fl_y, cx, cy, w and h in pixels.")
    cx, cy = read_number(entry, "cx", where), read_number(entry, "cy", where)
    inner = (
        fx if fx is not None else fy, fy if fy is not None else fx,
        width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model, coefficients = _distortion(entry, where)
    params = [value for value in (*inner, *coefficients) if value is not None]
    return make_lens(model, width, height, params, where)


def _focal(entry: Mapping[str, Any], axis: str, side: float, where: str) -> float | None:
    """Returns the focal length along an axis, given as such or as the angle of view."""
    focal = read_number(entry, f"fl_{axis}", where)
    if focal is not None:
        return focal
    angle = read_number(entry, f"camera_angle_{axis}", where)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise FormatError(
            f"{where} has camera_angle_{axis} = {angle:g}; needed are radians below pi.")
    return side / 2 / math.tan(angle / 2)


def _distortion(entry: Mapping[str, Any], where: str) -> tuple[str, tuple[float, ...]]:
    """Returns the camera model and its distortion coefficients."""
    named = entry.get("camera_model", "OPENCV_FISHEYE" if entry.get("is_fisheye") else "OPENCV")
    values = {key: read_number(entry, key, where) or 0.0 for key in _COEFFICIENTS}
    if named in _FISHEYE:
        if values["p1"] or values["p2"]:
            raise FormatError(f"{where}: {named} has no tangential distortion p1, p2.")
        return "OPENCV_FISHEYE", tuple(values[key] for key in ("k1", "k2", "k3", "k4"))
    if named not in _PERSPECTIVE:
        raise FormatError(
            f"{where} has the camera model {named}, known are "
            f"{', '.join(_PERSPECTIVE + _FISHEYE)}.",
            hint="Undistort the images first, for example with COLMAP's image_undistorter.")
    if not any(values.values()):
        return "PINHOLE", ()
    # nerfstudio's k4 is a fourth power of r^2, COLMAP's a divisor.
    if values["k4"] and named != "FULL_OPENCV":
        raise FormatError(f"{where} has k4 = {values['k4']:g}, which {named} does not have.")
    if named == "FULL_OPENCV" or values["k3"]:
        return "FULL_OPENCV", tuple(values[key] for key in _COEFFICIENTS)
    return "OPENCV", tuple(values[key] for key in ("k1", "k2", "p1", "p2"))


def read_number(entry: Mapping[str, Any], key: str, where: str) -> float | None:
    """Returns the finite number under a key, None where there is none; else FormatError."""
    value = entry.get(key)
    if value is None:
        return None
    # Whole numbers in JSON may be larger than any float.
    if type(value) not in (int, float) or not abs(value) <= _LARGEST:
        raise FormatError(f"{where} has {key} = {value!r:.40}; needed is a finite number.")
    return float(value)


@dataclass(frozen=True, eq=False)
class _Frame:
    """One entry of a file; `part` is train, val, test, "" for none of them, or None if unknown."""

    entry: Mapping[str, Any]
    where: str
    folder: Path
    path: Path
    part: str | None

    @property
    def listed(self) -> PurePosixPath:
        """The path below the folder."""
        return PurePosixPath(self.path.relative_to(self.folder).as_posix())


def is_transforms(path: Path) -> bool:
    """Returns whether a folder has the layout, or a file is such a .json by its name."""
    if path.suffix == ".json" and path.is_file():
        return path.name.startswith("transforms")
    return (path / _FILE).is_file() or (path / "transforms_train.json").is_file()


def read_transforms(path: Path) -> PosedSet:
    """Returns the frames of a transforms.json, or of transforms_train/val/test.json.

    If the set names test views, these are held out and its validation views are left out, as the
    literature scores it; if it names validation views alone, those are held out. InputError if no
    image exists; FormatError if a file is damaged or a frame incomplete.
    """
    table, frames = FrameTable(path), list[_Frame]()
    lists = [(file, part, _read_entries(file)) for file, part in _files(path)]
    finder = FileFinder(path.parent if path.is_file() else path, [
        entry[key] for _, _, (_, entries) in lists for entry in entries
        for key in ("file_path", "depth_file_path", "depth_path", "mask_path") if key in entry])
    for file, part, (common, entries) in lists:
        in_file, notices = _list_entries(file, part, common, entries, finder)
        frames += in_file
        table.notices += notices
    frames, copies = _drop_duplicates(frames)
    keep, held_out, split = split_parts([frame.part for frame in frames], path.name)
    used = [(frame, held) for frame, kept, held in zip(frames, keep, held_out, strict=True) if kept]
    for (frame, held), name in zip(used, _short_names([one for one, _ in used]), strict=True):
        if is_file(frame.path):
            table.add(_list_frame(frame, name, held, finder))
        else:
            table.missing.append(name)
    table.notices += [*copies, *split, *finder.notices(),
                      *_describe_unread([frame for frame, _ in used], table.rows)]
    posed = _add_points(table.finish(), path if path.is_file() else path / _FILE)
    depth = any(image.depth is not None for image in posed.images)
    return replace(posed, metric=depth, metric_by_depth=depth,
                   splits=any(image.held_out for image in posed.images))


def list_cameras(path: Path) -> list[tuple[str, Lens, NDArray[np.float64]]]:
    """Returns the name, lens and [4, 4] world to camera of every frame, whatever part it is of.

    The images need not exist where the file states their size. FormatError if a file is damaged or
    a frame incomplete.
    """
    lists = [(file, part, _read_entries(file)) for file, part in _files(path)]
    finder = FileFinder(path.parent if path.is_file() else path, [
        entry["file_path"] for _, _, (_, entries) in lists for entry in entries
        if "file_path" in entry])
    frames, _ = _drop_duplicates([
        frame for file, part, (common, entries) in lists
        for frame in _list_entries(file, part, common, entries, finder)[0]])
    return [(name, _stated_lens(frame), _viewmat(frame))
            for frame, name in zip(frames, _short_names(frames), strict=True)]


def _stated_lens(frame: _Frame) -> Lens:
    """Returns the lens of a frame at the size that its file states, or else of its image."""
    if frame.entry.get("w") is None or frame.entry.get("h") is None:
        if not is_file(frame.path):
            raise FormatError(
                f"{frame.where} states no size (w, h), and its image {frame.path} is missing.",
                hint="Add w and h in pixels, or copy the images too.")
        return read_lens(frame.entry, image_size(frame.path), frame.where)
    return read_lens(frame.entry, (0, 0), frame.where)


def _viewmat(frame: _Frame) -> NDArray[np.float64]:
    return viewmat_from_pose(
        frame.entry.get("transform_matrix", ()), f"{frame.where} transform_matrix", opengl=True)


def _describe_unread(frames: Sequence[_Frame], listed: Sequence[PosedImage]) -> list[str]:
    """Returns a notice about depth of NeRFCapture that is not read."""
    other = [frame for frame in frames if frame.entry.get("depth_path") is not None
             and frame.entry.get("depth_file_path") is None]
    unread = len(other) - sum(image.depth is not None for image in listed)
    if not other or unread <= 0:
        return []
    why = ("its unit is not given by integer_depth_scale"
           if other[0].entry.get("integer_depth_scale") is None
           else "files are missing, or have 8 bits, in which depth beyond a metre is cut off")
    return [f"the depth of {format_count(unread, 'frame')} is not read: {why}"]


def _files(path: Path) -> list[tuple[Path, str | None]]:
    """Returns the files to read, each with the part of the set that it holds."""
    if path.is_file():
        return [(path, None)]
    if (path / _FILE).is_file():
        return [(path / _FILE, None)]
    files = [(path / f"transforms_{part}.json", part) for part in PARTS]
    return [(file, part) for file, part in files if file.is_file()]


def _read_entries(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Returns a file's values for all frames, and its entries."""
    value = read_json(file, hint=_HINT, finite=False)
    entries = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(entries, list) or not entries:
        raise FormatError(f"{file} lists no frames.", hint=_HINT)
    tests = value.get("test_frames")  # ScanNet++'s
    entries = [*entries, *(tests if isinstance(tests, list) else ())]
    for at, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise FormatError(f"{file}, frame {at}, is not an object.", hint=_HINT)
    if tests and isinstance(tests, list):
        value["test_filenames"] = [entry.get("file_path") for entry in tests]
    return {key: item for key, item in value.items() if not key.endswith("frames")}, entries


def _list_entries(
    file: Path, part: str | None, common: dict[str, Any], entries: Sequence[dict[str, Any]],
    finder: FileFinder,
) -> tuple[list[_Frame], list[str]]:
    """Returns the frames of a file, and notices about the names in its lists."""
    parts, notices = _read_parts(common, part, entries, file)
    frames = []
    for at, (entry, own) in enumerate(zip(entries, parts, strict=True)):
        text = entry.get("file_path")
        path = finder.find(text, f"{file}, frame {at},")
        frames.append(_Frame({**common, **entry}, f"{file}, frame {text},", file.parent, path, own))
    return frames, notices


def _read_parts(
    shared: Mapping[str, Any], part: str | None, entries: Sequence[dict[str, Any]], file: Path
) -> tuple[Sequence[str | None], list[str]]:
    """Returns the part of each entry: that of nerfstudio's lists, or the one of the whole file."""
    lists = {}
    for kind in PARTS:
        names = shared.get(f"{kind}_filenames")
        if names is not None and not isinstance(names, list):
            raise FormatError(f"{file}: {kind}_filenames is not a list.", hint=_HINT)
        if names is not None:
            lists[kind] = names
    if not lists:
        return [part] * len(entries), []
    return match_parts(lists, [str(entry.get("file_path")) for entry in entries], file.name)


def _drop_duplicates(frames: Sequence[_Frame]) -> tuple[list[_Frame], list[str]]:
    """Returns the frames without those listed twice with the same pose, and a notice."""
    unique: dict[Path, _Frame] = {}
    copies = []
    for frame in frames:
        first = unique.setdefault(frame.path, frame)
        if first is frame:
            continue
        if first.entry.get("transform_matrix") != frame.entry.get("transform_matrix"):
            raise FormatError(
                f"{frame.where} is listed more than once with different poses.",
                hint="Leave one pose for each image.")
        copies.append(frame.listed)
        if _rank(frame.part) > _rank(first.part):
            unique[frame.path] = frame
    notices = []
    if copies:
        notices.append(
            f"listed more than once: {format_count(len(copies), 'image')}, the first is "
            f"{copies[0]}")
    return list(unique.values()), notices


def _rank(part: str | None) -> int:
    return PARTS.index(part) if part in PARTS else -1


def _short_names(frames: Sequence[_Frame]) -> list[str]:
    """Returns the listed paths without the folders that all of them share."""
    parts = [frame.listed.parts for frame in frames]
    folders = [path[:-1] for path in parts]
    shared = 0
    while folders and all(len(path) > shared and path[shared] == folders[0][shared]
                          for path in folders):
        shared += 1
    return ["/".join(path[shared:]) for path in parts]


def _list_frame(frame: _Frame, name: str, held_out: bool, finder: FileFinder) -> PosedImage:
    lens = read_lens(frame.entry, image_size(frame.path), frame.where)
    return PosedImage(
        name, frame.path, lens, _viewmat(frame), held_out,
        _find_depth(frame, lens, finder), _beside(frame, "mask_path", finder),
        time=find_number(frame.entry, "timestamp"))


def _find_depth(frame: _Frame, lens: Lens, finder: FileFinder) -> DepthFile | None:
    """Returns the depth of a frame: nerfstudio's, else NeRFCapture's if its unit is known."""
    path = _beside(frame, "depth_file_path", finder)
    if path is not None:
        return DepthFile(path, _unit(frame), lens)
    unit = read_number(frame.entry, "integer_depth_scale", frame.where)
    if unit is None or unit <= 0 or frame.entry.get("depth_path") is None:
        return None
    path = finder.find(frame.entry["depth_path"], f"{frame.where} depth_path")
    if not is_file(path) or not _has_16_bits(path):
        return None
    return DepthFile(path, unit, lens, reliable=LIDAR_RANGE)


def _has_16_bits(path: Path) -> bool:
    """Returns whether a picture has more than 8 bits; an unreadable one is reported later."""
    try:
        with Image.open(path) as image:
            return image.mode not in ("1", "L", "P", "LA", "RGB", "RGBA")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return True


def _beside(frame: _Frame, key: str, finder: FileFinder) -> Path | None:
    """Returns the file of depth or mask that a frame names, which must exist."""
    if frame.entry.get(key) is None:
        return None
    path = finder.find(frame.entry[key], f"{frame.where} {key}")
    if not is_file(path):
        raise FormatError(
            f"{frame.where} names the {key} {path}, which is missing.",
            hint=f"Copy the file, or take {key} out of the list.")
    return path


def _unit(frame: _Frame) -> float:
    unit = read_number(frame.entry, "depth_unit_scale_factor", frame.where)
    if unit is not None and unit <= 0:
        raise FormatError(
            f"{frame.where} has depth_unit_scale_factor = {unit:g}; needed is one above 0.",
            hint=_HINT)
    return MILLIMETRE if unit is None else unit  # nerfstudio's default


def _add_points(posed: PosedSet, file: Path) -> PosedSet:
    """Returns the set with nerfstudio's sparse points; a notice where they are missing."""
    name = read_json(file, hint=_HINT, finite=False).get("ply_file_path") if is_file(file) else None
    if name is None:
        return posed
    path = resolve_inside(file.parent, name, f"{file}, ply_file_path,")
    if not is_file(path):
        return replace(posed, notices=(*posed.notices, f"its points {name} are missing"))
    points, colors = read_cloud(path)
    return replace(posed, points=points, colors=colors)


@dataclass(frozen=True)
class DepthPaths:
    """The files of depth, PNGs of 16 bits, by the paths of their images."""

    files: Mapping[str, str]  # below the folder of the .json
    unit: float  # world units of a value of 1


def write_transforms(
    path: Path, views: Sequence[tuple[str, Camera]], *, held_out: Collection[str] = (),
    points: str | None = None, depth: DepthPaths | None = None,
) -> None:
    """Writes the cameras of images, by paths below the folder of the file, atomically.

    Intrinsics that all cameras share are written once. With held-out paths the lists
    train_filenames, val_filenames and test_filenames are written; the last two are those images,
    because nerfstudio requires both. `points` is the name of a point cloud beside the file, in the
    same world, where nerfstudio starts Gaussians; `depth` has a file for every image. InputError if
    there are no views; ValueError if a path leaves the folder, appears twice, or is held out but no
    view.
    """
    if not views:
        raise InputError("There are no cameras to write.", hint=Hint("sfm", then=" first"))
    names = [name for name, _ in views]
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ValueError(f"{name} is not a path below the folder of {path}")
    if len(set(names)) < len(names) or not set(held_out) <= set(names):
        raise ValueError("duplicate views, or held-out ones that do not exist")
    inner = [_intrinsics(camera) for _, camera in views]
    shared = all(intrinsics == inner[0] for intrinsics in inner)
    value: dict[str, Any] = {"camera_model": "PINHOLE", **(inner[0] if shared else {})}
    if points is not None:
        value["ply_file_path"] = points
    if depth is not None:
        value["depth_unit_scale_factor"] = depth.unit
    if held_out:
        test = [name for name in names if name in held_out]
        value |= {"train_filenames": [name for name in names if name not in held_out],
                  "val_filenames": test, "test_filenames": test}
    value["frames"] = [
        {"file_path": name, **({} if shared else intrinsics),
         **({} if depth is None else {"depth_file_path": depth.files[name]}),
         "transform_matrix": pose_from_viewmat(camera.viewmat).tolist()}
        for (name, camera), intrinsics in zip(views, inner, strict=True)]
    write_json(path, value)


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "w": camera.width, "h": camera.height}
