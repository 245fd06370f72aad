"""Whole COLMAP models of any camera model, binary or text, with rigs and frames or without.

Read by our own checked readers for the reasons that io/colmap.py gives. Newer models have rigs and
frames beside their images, but images.bin and images.txt still hold the composed pose of each image
(pycolmap 4.2), so rigs and frames are read only where the images file itself is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.calibration import checked_lens
from recon_cli.io.colmap import Reader, damaged, read_images, read_points, rigid
from recon_cli.io.colmap_text import (
    Sensor,
    read_cameras_text,
    read_frames_text,
    read_images_text,
    read_points_text,
    read_rigs_text,
)
from recon_cli.scene.camera import MODELS, Lens

# COLMAP's ids of its camera models, src/colmap/sensor/models.h and pycolmap 4.2's CameraModelId.
_IDS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
    "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE",
    "EUCM", "EQUIRECTANGULAR",
)
_SENSORS = {0: "CAMERA", 1: "IMU"}
_HINT = "Copy the model again, or export it again from COLMAP."


@dataclass(frozen=True, eq=False)
class Model:
    """A COLMAP model without its observations.

    Attributes:
        lenses: intrinsics by camera id.
        images: (name, camera id, [4, 4] world to camera) in the order of the file.
        unnamed: (camera id, [4, 4] world to camera) by image id, where the file with the names is
            missing; else empty.
        points: [P, 3] float64 sparse points.
        colors: [P, 3] uint8 their RGB colours.
    """

    lenses: dict[int, Lens]
    images: list[tuple[str, int, NDArray[np.float64]]]
    unnamed: dict[int, tuple[int, NDArray[np.float64]]]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]


def model_suffix(folder: Path) -> str | None:
    """Returns .bin or .txt for the form of the model in a folder, None where there is none."""
    for suffix in (".bin", ".txt"):
        if (folder / f"cameras{suffix}").is_file() and any(
                (folder / f"{name}{suffix}").is_file() for name in ("images", "frames")):
            return suffix
    return None


def read_model(folder: Path) -> Model:
    """Returns the model in a folder; binary where it is there in both forms.

    Raises:
        FormatError: the folder holds no model, or one that is damaged.
    """
    suffix = model_suffix(folder)
    if suffix is None:
        raise FormatError(f"{folder} holds no COLMAP model.", hint=_HINT)
    binary = suffix == ".bin"
    cameras, images, points = (
        folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    lenses = read_lenses(cameras) if binary else read_cameras_text(cameras)
    named: list[tuple[str, int, NDArray[np.float64]]] = []
    unnamed: dict[int, tuple[int, NDArray[np.float64]]] = {}
    if images.is_file():
        named = read_images(images, hint=_HINT) if binary else read_images_text(images)
    else:
        unnamed = _compose(folder, binary=binary)
    used = {camera for _, camera, _ in named} | {camera for camera, _ in unnamed.values()}
    if unknown := sorted(used - lenses.keys()):
        raise damaged(folder, f"images of the unknown camera {unknown[0]}", _HINT)
    if not used:
        raise damaged(folder, "no image has a pose", _HINT)
    if not points.is_file():
        return Model(lenses, named, unnamed, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    positions, colors = (
        read_points(points, hint=_HINT) if binary else read_points_text(points))
    return Model(lenses, named, unnamed, positions, colors)


def read_lenses(path: Path) -> dict[int, Lens]:
    """Returns the lenses of a cameras.bin by camera id.

    Raises:
        FormatError: the file is damaged or holds a camera of an unknown model.
    """
    reader = Reader(path, _HINT)
    lenses = {}
    for _ in range(reader.count(minimum=24)):
        camera_id, model, width, height = reader.take("<IiQQ")
        name = _IDS[model] if 0 <= model < len(_IDS) else str(model)
        params = reader.take(f"<{MODELS[name][1]}d") if name in MODELS else ()
        lenses[camera_id] = checked_lens(
            name, width, height, params, f"{path}, camera {camera_id},")
    reader.end()
    return lenses


def _compose(folder: Path, *, binary: bool) -> dict[int, tuple[int, NDArray[np.float64]]]:
    """Returns camera id and world to camera of each image id, from rigs and frames."""
    suffix = ".bin" if binary else ".txt"
    rigs_file, frames_file = folder / f"rigs{suffix}", folder / f"frames{suffix}"
    rigs = _read_rigs(rigs_file) if binary else read_rigs_text(rigs_file)
    frames = _read_frames(frames_file) if binary else read_frames_text(frames_file)
    poses = {}
    for rig_id, rig_from_world, data in frames:
        for sensor, image_id in data:
            if sensor[0] != "CAMERA":
                continue
            sensor_from_rig = rigs.get(rig_id, {}).get(sensor)
            if sensor_from_rig is None:
                raise damaged(
                    rigs_file, f"no place of camera {sensor[1]} in rig {rig_id}", _HINT)
            poses[image_id] = sensor[1], sensor_from_rig @ rig_from_world
    return dict(sorted(poses.items()))


def _read_rigs(path: Path) -> dict[int, dict[Sensor, NDArray[np.float64]]]:
    reader = Reader(path, _HINT)
    rigs = {}
    for _ in range(reader.count(minimum=8)):
        rig_id, count = reader.take("<II")
        sensors: dict[Sensor, NDArray[np.float64]] = {}
        for index in range(count):
            kind, sensor_id = reader.take("<iI")
            sensor = _SENSORS.get(kind, str(kind)), sensor_id
            if index == 0:  # the origin of the rig
                sensors[sensor] = np.eye(4)
            elif reader.take("<B")[0]:
                sensors[sensor] = _pose(reader, path)
        rigs[rig_id] = sensors
    reader.end()
    return rigs


def _read_frames(
    path: Path,
) -> list[tuple[int, NDArray[np.float64], list[tuple[Sensor, int]]]]:
    reader = Reader(path, _HINT)
    frames = []
    for _ in range(reader.count(minimum=68)):
        _, rig_id = reader.take("<II")
        pose = _pose(reader, path)
        data: list[tuple[Sensor, int]] = []
        for _ in range(reader.take("<I")[0]):
            kind, sensor_id, image_id = reader.take("<iIQ")
            data.append(((_SENSORS.get(kind, str(kind)), sensor_id), image_id))
        frames.append((rig_id, pose, data))
    reader.end()
    return frames


def _pose(reader: Reader, path: Path) -> NDArray[np.float64]:
    matrix = rigid(reader.take("<7d"))
    if matrix is None:
        raise damaged(path, "a pose that is not finite or has no rotation", _HINT)
    return matrix
