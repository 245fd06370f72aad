"""RGB-D sequences with poses: 7-Scenes, and the TUM RGB-D benchmark.

7-Scenes (Shotton et al. 2013; 3DMatch has the same layout): frame-%06d.color.png, .depth.png in
millimetres (65535 is unknown) and .pose.txt in one folder, camera-intrinsics.txt there or one level
up. TUM RGB-D (Sturm et al. 2012): rgb/ and depth/ (5000 is a metre) with the times of their files
in rgb.txt and depth.txt, and the camera's path in groundtruth.txt. Poses are camera to world,
OpenCV axes, metres.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.datasets.depth_file import MILLIMETRE, DepthFile
from recon_cli.datasets.posed import (
    PosedImage,
    PosedSet,
    image_size,
    is_file,
    resolve_inside,
)
from recon_cli.datasets.rgbd import read_matrix, read_pose, tracked_sequence
from recon_cli.datasets.trajectory import Trajectory
from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import lens_from_matrix
from recon_cli.scene.camera import Lens, make_lens

_COLOR = re.compile(r"frame-(\d+)\.color\.(?:png|jpg|jpeg)", re.IGNORECASE)
_INTRINSICS = "camera-intrinsics.txt"
_UNKNOWN = 65535.0
# fx, fy, cx, cy of the Kinect at 640x480: nominal for colours, those of the data set for depth.
_COLOR_KINECT = (525.0, 525.0, 320.0, 240.0)
_DEPTH_KINECT = (585.0, 585.0, 320.0, 240.0)
_KINECT_SIZE = (640, 480)

_TUM_DEPTH = 1 / 5000
# fx fy cx cy k1 k2 p1 p2 k3 as the benchmark publishes them for its three cameras; the centre of
# the first pixel is at 0 there. Sequences of other names get the nominal ones.
_TUM_CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
    "": (525.0, 525.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0, 0.0),
}
_TUM_NAME = re.compile(r"(?:freiburg|fr)([123])(?![0-9])", re.IGNORECASE)
_DEPTH_APART = 0.02  # seconds, within which the benchmark's own tool pairs depth with colours


def is_seven_scenes(folder: Path) -> bool:
    """Returns whether a folder has the layout."""
    return folder.is_dir() and next(folder.glob("frame-*.pose.txt"), None) is not None


def is_tum(folder: Path) -> bool:
    """Returns whether a folder has the layout."""
    return (folder / "rgb").is_dir() and all(
        (folder / name).is_file() for name in ("rgb.txt", "groundtruth.txt"))


def find_unposed(folder: Path) -> tuple[str, Path] | None:
    """Returns the files that colours and depth without poses lack, and a better input."""
    if not is_seven_scenes(folder) and folder.is_dir() and all(
            next(folder.glob(f"frame-*.{kind}.*"), None) for kind in ("color", "depth")):
        return "7-Scenes frames without their .pose.txt", folder / "frame-*.color.*"
    if not is_tum(folder) and (folder / "rgb.txt").is_file() and all(
            (folder / name).is_dir() for name in ("rgb", "depth")):
        return "a TUM RGB-D sequence without groundtruth.txt", folder / "rgb"
    return None


def read_seven_scenes(folder: Path) -> PosedSet:
    """Returns a sequence of 7-Scenes without the frames whose tracking was lost.

    InputError if no frame has an image and a pose; FormatError if a pose or the intrinsics are
    damaged, or missing at another size than 640x480.
    """
    colors = {int(match[1]): path for path in sorted(folder.iterdir())
              if (match := _COLOR.fullmatch(path.name))}
    stems = {number: path.name.split(".")[0] for number, path in colors.items()}
    poses = {number: path for number, stem in stems.items()
             if (path := folder / f"{stem}.pose.txt").is_file()}
    if not poses:
        raise InputError(
            f"{folder} has {len(colors)} frames like frame-000000.color.png, none of them with a "
            ".pose.txt.", hint="Unpack the complete sequence into one folder.")
    lens, depth_lens, notices = _kinect(folder, image_size(next(iter(colors.values()))))
    listed = []
    for number in poses:
        viewmat = read_pose(poses[number])
        if viewmat is None:
            continue
        path = folder / f"{stems[number]}.depth.png"
        depth = DepthFile(path, MILLIMETRE, lens, depth_lens, unknown=_UNKNOWN)
        listed.append(PosedImage(
            colors[number].name, colors[number], lens, viewmat,
            depth=depth if path.is_file() else None))
    return tracked_sequence("7scenes", listed, folder, len(colors) - len(listed), notices)


def _kinect(folder: Path, size: tuple[int, int]) -> tuple[Lens, Lens | None, tuple[str, ...]]:
    """Returns the lens of the colours, that of depth where it is another, and notices."""
    path = next((place / _INTRINSICS for place in (folder, folder.absolute().parent)
                 if (place / _INTRINSICS).is_file()), None)
    if path is not None:
        return lens_from_matrix(read_matrix(path), *size, str(path)), None, ()
    if size != _KINECT_SIZE:
        raise FormatError(
            f"{folder} has no {_INTRINSICS}, and its images have {size[0]}x{size[1]} pixels; known "
            "are the intrinsics for 640x480.",
            hint=f"Write {_INTRINSICS}: fx 0 cx, 0 fy cy, 0 0 1 in three lines.")
    lens, depth = (make_lens("PINHOLE", *size, params, str(folder))
                   for params in (_COLOR_KINECT, _DEPTH_KINECT))
    return lens, depth, (
        f"it has no {_INTRINSICS}: a Kinect's usual focal length of {_COLOR_KINECT[0]:.0f} pixels "
        "is assumed; `recon sfm --poses refine` corrects it",)


def read_tum(folder: Path) -> PosedSet:
    """Returns a TUM RGB-D sequence without the frames that motion capture lost.

    Poses of the frames' own times are taken, others interpolated. InputError if no frame has an
    image and a pose; FormatError if a list is damaged or names files outside the folder.
    """
    names, times = _read_list(folder, "rgb.txt")
    camera = _TUM_NAME.search(folder.absolute().name)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = _TUM_CAMERAS[camera[1] if camera else ""]
    inner = (fx, fy, cx + 0.5, cy + 0.5)
    model, distortion = ("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)) if k1 else (
        "PINHOLE", ())
    lens = make_lens(model, *_KINECT_SIZE, (*inner, *distortion), str(folder))
    path = _read_trajectory(folder / "groundtruth.txt")
    viewmats = [path.viewmat(time) for time in times]
    depths = _pair_depth(folder, times)
    listed = [
        PosedImage(
            PurePosixPath(name).name, resolve_inside(folder, name, f"{folder / 'rgb.txt'}"),
            lens, viewmat,
            depth=None if depth is None else DepthFile(depth, _TUM_DEPTH, lens))
        for name, viewmat, depth in zip(names, viewmats, depths, strict=True)
        if viewmat is not None]
    notices = () if camera else (
        f"its name holds neither freiburg1, 2 nor 3: a Kinect's usual focal length of {fx:.0f} "
        "pixels is assumed; `recon sfm --poses refine` corrects it",)
    return tracked_sequence("tum", listed, folder, len(names) - len(listed), notices)


def _read_rows(path: Path, least: int) -> list[list[str]]:
    """Returns the words of each line, at least so many, without comments."""
    if not path.is_file():
        raise FormatError(f"{path} is missing.", hint="Unpack the complete sequence again.")
    rows = []
    for at, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < least:
            raise FormatError(f"{path}, line {at}, has {len(words)} words, needed {least}.")
        rows.append(words)
    return rows


def _numbers(rows: Sequence[Sequence[str]], path: Path) -> NDArray[np.float64]:
    try:
        values = np.array(rows, np.float64)
    except ValueError as error:
        raise FormatError(f"{path} holds something other than numbers.") from error
    if not np.isfinite(values).all():
        raise FormatError(f"{path} holds a number that is not finite.")
    return values


def _read_list(folder: Path, name: str) -> tuple[list[str], NDArray[np.float64]]:
    """Returns the files that rgb.txt or depth.txt lists, and their times, in order of time."""
    rows = _read_rows(folder / name, 2)
    if not rows:
        raise FormatError(f"{folder / name} lists no files.")
    times = _numbers([row[0] for row in rows], folder / name)
    order = np.argsort(times, kind="stable")
    return [rows[at][1] for at in order], times[order]


def _read_trajectory(path: Path) -> Trajectory:
    values = _numbers([row[:8] for row in _read_rows(path, 8)], path)
    if len(values) < 2 or not np.linalg.norm(values[:, 4:8], axis=1).all():
        raise FormatError(f"{path} holds no path: needed are lines of time tx ty tz qx qy qz qw.")
    return Trajectory(values[:, 0], Rotation.from_quat(values[:, 4:8]), values[:, 1:4])


def _pair_depth(folder: Path, times: NDArray[np.float64]) -> list[Path | None]:
    """Returns the depth file nearest in time to each frame, None where none is near."""
    if not (folder / "depth.txt").is_file():
        return [None] * len(times)
    names, known = _read_list(folder, "depth.txt")
    nearest = [int(np.argmin(np.abs(known - time))) for time in times]
    paths = [resolve_inside(folder, names[at], f"{folder / 'depth.txt'}") for at in nearest]
    return [path if abs(known[at] - time) <= _DEPTH_APART and is_file(path) else None
            for at, path, time in zip(nearest, paths, times, strict=True)]
