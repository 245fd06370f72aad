"""RGB-D sequences with poses: 7-Scenes, and the TUM RGB-D benchmark.

7-Scenes (Shotton et al. 2013; 3DMatch has the same layout): frame-%06d.color.png, .depth.png in
millimetres (65535 is unknown) and .pose.txt in one folder, camera-intrinsics.txt there or one level
up. TUM RGB-D (Sturm et al. 2012): rgb/ and depth/ (5000 is a metre) with the times of their files
in rgb.txt and depth.txt, and the camera's path in groundtruth.txt. Poses are camera to world,
OpenCV axes, metres.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon_cli.datasets.depth_file import MILLIMETRE, DepthFile
from recon_cli.datasets.frame_files import (
    PICTURES,
    list_numbered,
    parse_numbers,
    quoted,
    read_rows,
)
from recon_cli.datasets.frame_table import FrameTable, LeftOutError, nearest
from recon_cli.datasets.posed import (
    PosedImage,
    PosedSet,
    image_size,
    is_file,
    resolve_inside,
)
from recon_cli.datasets.rgbd import read_matrix, read_pose
from recon_cli.datasets.trajectory import Trajectory
from recon_cli.errors import FormatError, InputError, name_command
from recon_cli.io.calibration import lens_from_matrix
from recon_cli.scene.camera import Lens, make_lens

_INTRINSICS = "camera-intrinsics.txt"
# fx, fy, cx, cy of the Kinect at 640x480: nominal for colours, those of the data set for depth.
_COLOR_KINECT = (525.0, 525.0, 320.0, 240.0)
_DEPTH_KINECT = (585.0, 585.0, 320.0, 240.0)
_KINECT_SIZE = (640, 480)
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


def read_seven_scenes(folder: Path) -> PosedSet:
    """Returns a sequence of 7-Scenes without the frames whose tracking was lost.

    InputError if no frame has an image and a pose; FormatError if a pose or the intrinsics are
    damaged, or missing at another size than 640x480.
    """
    colors, poses, depths = (
        list_numbered(folder, suffixes, rf"frame-([0-9]+)\.{kind}") for kind, suffixes in (
            ("color", PICTURES), ("pose", (".txt",)), ("depth", (".png",))))
    if not colors.keys() & poses.keys():
        raise InputError(
            f"{folder} has {len(colors)} frames like frame-000000.color.png, none of them with a "
            ".pose.txt.", hint="Unpack the complete sequence into one folder.")
    table = FrameTable(folder, pictures=f"{quoted(folder)}/frame-*.color.*")
    lens, depth_lens = _kinect(folder, image_size(next(iter(colors.values()))), table)
    for number, path in colors.items():
        with table.frame(path.name):
            viewmat = read_pose(poses.get(number))
            depth = DepthFile(
                depths[number], MILLIMETRE, lens, depth_lens,
                unknown=np.iinfo(np.uint16).max) if number in depths else None
            table.add(PosedImage(path.name, path, lens, viewmat, depth=depth))
    return replace(table.finish(), metric=True, sequence=True)


def _kinect(
    folder: Path, size: tuple[int, int], table: FrameTable
) -> tuple[Lens, Lens | None]:
    """Returns the lens of the colours, and that of depth where it is another."""
    path = next((place / _INTRINSICS for place in (folder, folder.absolute().parent)
                 if (place / _INTRINSICS).is_file()), None)
    if path is not None:
        return lens_from_matrix(read_matrix(path), *size, str(path)), None
    if size != _KINECT_SIZE:
        raise FormatError(
            f"{folder} has no {_INTRINSICS}, and its images have {size[0]}x{size[1]} pixels; known "
            "are the intrinsics for 640x480.",
            hint=f"Write {_INTRINSICS}: fx 0 cx, 0 fy cy, 0 0 1 in three lines.")
    lens, depth = (make_lens("PINHOLE", *size, params, str(folder))
                   for params in (_COLOR_KINECT, _DEPTH_KINECT))
    table.notices.append(
        f"it has no {_INTRINSICS}: a Kinect's usual focal length of {_COLOR_KINECT[0]:.0f} pixels "
        f"is assumed; {name_command('sfm --poses refine')} corrects it")
    return lens, depth


def read_tum(folder: Path) -> PosedSet:
    """Returns a TUM RGB-D sequence without the frames that motion capture lost.

    Poses of the frames' own times are taken, others interpolated. InputError if no frame has an
    image and a pose; FormatError if a list is damaged or names files outside the folder.
    """
    colors = _read_list(folder, "rgb.txt")
    camera = _TUM_NAME.search(folder.absolute().name)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = _TUM_CAMERAS[camera[1] if camera else ""]
    inner = (fx, fy, cx + 0.5, cy + 0.5)
    model, distortion = ("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)) if k1 else (
        "PINHOLE", ())
    lens = make_lens(model, *_KINECT_SIZE, (*inner, *distortion), str(folder))
    trajectory = _read_trajectory(folder / "groundtruth.txt")
    depths = dict(reversed(
        _read_list(folder, "depth.txt") if (folder / "depth.txt").is_file() else []))
    table = FrameTable(folder, pictures=folder / "rgb")
    for time, path in colors:
        with table.frame(path.name):
            viewmat = trajectory.viewmat(time)
            if viewmat is None:
                raise LeftOutError("whose tracking was lost")
            depth = nearest(depths, time, _DEPTH_APART)
            table.add(PosedImage(
                path.name, path, lens, viewmat,
                depth=DepthFile(depth, 1 / 5000, lens) if depth and is_file(depth) else None))
    if not camera:
        table.notices.append(
            f"its name holds neither freiburg1, 2 nor 3: a Kinect's usual focal length of {fx:.0f} "
            f"pixels is assumed; {name_command('sfm --poses refine')} corrects it")
    return replace(table.finish(), metric=True, sequence=True)


def _read_list(folder: Path, name: str) -> list[tuple[float, Path]]:
    """Returns the times and files that rgb.txt or depth.txt lists, in order of time."""
    files = []
    for where, words in read_rows(folder / name):
        time = parse_numbers(words[:1], where, 1)
        files.append((float(time[0]), resolve_inside(folder, " ".join(words[1:2]), where)))
    if not files:
        raise FormatError(f"{folder / name} lists no files.")
    return sorted(files, key=lambda file: file[0])


def _read_trajectory(path: Path) -> Trajectory:
    values = np.array([parse_numbers(words[:8], where, 8) for where, words in read_rows(path)])
    if len(values) < 2 or not np.linalg.norm(values[:, 4:8], axis=1).all():
        raise FormatError(f"{path} holds no path: needed are lines of time tx ty tz qx qy qz qw.")
    return Trajectory(values[:, 0], Rotation.from_quat(values[:, 4:8]), values[:, 1:4])
