"""RTAB-Map, as `rtabmap-export --images --poses_camera` writes it.

NAME_rgb/<stamp>.jpg (stereo: NAME_left), NAME_depth/<stamp>.png in millimetres,
NAME_calib/<stamp>.yaml (OpenCV's), NAME_camera_poses.txt: `#timestamp x y z qx qy qz qw id`, or
without the id. Poses are camera to world, OpenCV's axes, z up, metres, optimised. With --images_id
files are called by the id. Several cameras have _0, _1 at the ends of names. Without it,
NAME_poses.txt holds the robot's base: the camera is base * local_transform of its yaml.
NAME_confidence/<stamp>.png says how far depth is to be trusted, on a scale that is written nowhere.
(introlab/rtabmap: tools/Export/main.cpp, Graph.cpp, CameraModel.cpp.)
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.datasets.depth_file import lidar_depth
from recon_cli.datasets.frame_files import PICTURES, fit_intrinsics, pose_from_quat
from recon_cli.datasets.frame_table import Z_UP, FrameTable, LeftOutError, nearest
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_text

_POSES = re.compile(r"(.+)_camera_poses(?:_(\d+))?\.txt")
_BASE = re.compile(r"(.+)_poses\.txt")
_NUMBERS = r"\s*:\s*\[([^\]]*)\]"
_NEAR = 1e-4  # seconds; stamps are written with 6 decimals
_SCALES = (2, 100, 255)  # largest values of confidence: ARKit's levels, percent, 8 bits
_ASKED = 20  # files of confidence that are looked at for the largest value


def find_rtabmap(folder: Path) -> list[tuple[str, str, Path, bool]]:
    """Returns name, suffix of the camera, file of poses, and whether these are the base's."""
    cameras = []
    files = sorted(folder.glob("*_poses*.txt")) if folder.is_dir() else []
    for path in files:
        match = _POSES.fullmatch(path.name)
        if match and _pictures(folder, match[1]):
            cameras.append((match[1], f"_{match[2]}" if match[2] else "", path, False))
    if not cameras:
        for path in files:
            match = _BASE.fullmatch(path.name)
            if match and _pictures(folder, match[1]) and (folder / f"{match[1]}_calib").is_dir():
                cameras.append((match[1], "", path, True))
    return cameras


def _pictures(folder: Path, name: str) -> Path | None:
    return next((place for kind in ("rgb", "left")
                 if (place := folder / f"{name}_{kind}").is_dir()), None)


def read_rtabmap(folder: Path) -> PosedSet:
    """Returns the images with a pose and a calibration.

    InputError if there is none; FormatError if the poses have no time stamps or are damaged.
    """
    cameras = find_rtabmap(folder)
    table = FrameTable(folder, pictures=_pictures(folder, cameras[0][0]) or folder)
    unused = sum(_add_camera(table, folder, name, camera, path, base)
                 for name, camera, path, base in (cameras[:1] if cameras[0][3] else cameras))
    table.notices += [
        f"its confidence has values up to {scale}, which are taken as certain" for scale in {
            image.depth.confidence.high for image in table.rows
            if image.depth and image.depth.confidence}]
    return table.finish_tracked(up=Z_UP, without_picture=unused)


def _add_camera(
    table: FrameTable, folder: Path, name: str, camera: str, path: Path, base: bool
) -> int:
    """Adds the images of one camera, and returns how many poses have none."""
    place = _pictures(folder, name)
    assert place is not None
    count, by_time, by_id = _read_poses(path)
    levels = {file.stem: file for file in sorted((folder / f"{name}_confidence").glob("*.png"))}
    scale = _confidence_scale(list(levels.values()))
    several = camera or next(place.glob("*_0.*"), None)
    used = set[int]()
    for image in sorted(place.iterdir(), key=lambda one: _order(one.stem)):
        if image.suffix.lower() not in PICTURES:
            continue
        stem = image.stem
        if several:
            stem, mark, number = stem.rpartition("_")
            if not mark and camera in ("", "_0"):
                table.leave_out(image.name, "that hold several cameras beside each other")
            if f"_{number}" != (camera or "_0"):
                continue
        with table.frame(image.name):
            pose = _look_up(stem, by_time, by_id)
            if pose is None:
                raise LeftOutError(f"without a pose in {path.name}")
            used.add(id(pose))
            lens, local = _read_calibration(folder / f"{name}_calib" / f"{image.stem}.yaml")
            viewmat = table.pose(np.matmul, pose, local if base else np.eye(4))
            depth = folder / f"{name}_depth" / f"{image.stem}.png"
            table.add(PosedImage(
                image.name, image, lens, viewmat, time=float(stem) if "." in stem else None,
                depth=lidar_depth(depth if depth.is_file() else None, levels.get(image.stem), lens,
                                  high=scale)))
    return count - len(used)


def _confidence_scale(files: Sequence[Path]) -> int:
    """Returns the value that means certain: the least usual one that no file exceeds."""
    largest = 0
    for path in files[::max(1, len(files) // _ASKED)]:
        try:
            with Image.open(path, formats=("PNG",)) as image:
                largest = max(largest, int(np.asarray(image).max(initial=0)))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
            continue  # its frame says so
    return next((scale for scale in _SCALES if largest <= scale), _SCALES[-1])


def _order(stem: str) -> tuple[float, str]:
    number = stem.split("_")[0]
    return (float(number) if number.replace(".", "", 1).isdecimal() else 0.0), stem


Poses = dict[float, NDArray[np.float64]]


def _read_poses(path: Path) -> tuple[int, Poses, Poses]:
    """Returns how many poses there are, and camera to world by time and by id; no landmarks."""
    try:
        lines = read_text(path).splitlines()
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    count, by_time, by_id = 0, Poses(), Poses()
    rows = [line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    for at, row in enumerate(rows):
        if len(row) not in (8, 9):
            if at == len(rows) - 1 and at:  # cut short
                continue
            raise FormatError(
                f"{path} has {len(row)} words in a line; needed are 8 or 9: the time, x y z, "
                "qx qy qz qw, and the id.")
        values = [_float(word) for word in row]
        if len(row) == 9 and values[8] < 0:  # a landmark
            continue
        try:
            pose = pose_from_quat(values[4:8], values[1:4])
        except ValueError:
            pose = np.full((4, 4), np.nan)
        count += 1
        if np.isfinite(values[0]):
            by_time.setdefault(values[0], pose)
        if len(row) == 9 and np.isfinite(values[8]):
            by_id[int(values[8])] = pose
    return count, dict(sorted(by_time.items())), by_id


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _look_up(stem: str, by_time: Poses, by_id: Poses) -> NDArray[np.float64] | None:
    """Returns the pose of a file, by its id, else by its time."""
    if stem.isdecimal() and int(stem) in by_id:
        return by_id[int(stem)]
    return nearest(by_time, _float(stem), _NEAR)


def _read_calibration(path: Path) -> tuple[Lens, NDArray[np.float64]]:
    """Returns the lens and local_transform of OpenCV's YAML; LeftOutError if it is none."""
    try:
        return _parse_calibration(read_text(path), path)
    except (OSError, ValueError, FormatError) as error:
        raise LeftOutError("without a calibration that can be read") from error


def _parse_calibration(text: str, path: Path) -> tuple[Lens, NDArray[np.float64]]:
    sizes = [re.search(rf"^image_{side}\s*:\s*(\d+)", text, re.MULTILINE)
             for side in ("width", "height")]
    matrix = _data(text, "camera_matrix")
    if sizes[0] is None or sizes[1] is None or len(matrix) != 9:
        raise FormatError(f"{path} lacks image_width, image_height or camera_matrix.")
    width, height = int(sizes[0][1]), int(sizes[1][1])
    inner, factor = fit_intrinsics(
        (matrix[0], matrix[4], matrix[2], matrix[5]), (width, height), str(path))
    if factor != 1:
        raise FormatError(f"{path} has intrinsics for images of another size than it says.")
    lens = make_lens("PINHOLE", width, height, inner, str(path))
    local = _data(text, "local_transform")
    transform = np.eye(4)
    if len(local) == 12:
        transform[:3] = np.reshape(local, (3, 4))
    distortion = _data(text, "distortion_coefficients")
    if not any(distortion):
        return lens, transform
    if "equidistant" in text and len(distortion) >= 4:
        return make_lens("OPENCV_FISHEYE", width, height, (*inner, *_fisheye(distortion)),
                         str(path)), transform
    if len(distortion) not in (4, 5, 8):  # k1 k2 p1 p2 (k3), and k4 k5 k6
        raise FormatError(f"{path} has {len(distortion)} coefficients of distortion.")
    padded = (*distortion, *[0.0] * (8 - len(distortion)))
    return make_lens("FULL_OPENCV", width, height, (*inner, *padded), str(path)), transform


def _fisheye(distortion: list[float]) -> list[float]:
    """Returns k1 to k4; with 6 numbers they are k1 k2 0 0 k3 k4 (CameraModel.cpp)."""
    return distortion[:2] + distortion[4:6] if len(distortion) == 6 else distortion[:4]


def _data(text: str, key: str) -> list[float]:
    """Returns the numbers of a matrix in OpenCV's YAML; empty where there is none."""
    block = re.search(rf"^{key}\s*:(.*?)(?=^\S|\Z)", text, re.MULTILINE | re.DOTALL)
    numbers = re.search(rf"data{_NUMBERS}", block[1]) if block else None
    try:
        return [float(one) for one in numbers[1].split(",")] if numbers else []
    except ValueError:
        return []
