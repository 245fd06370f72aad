"""OpenSfM and OpenDroneMap: reconstruction.json, or OpenDroneMap's cameras.json and shots.geojson.

A shot has an axis-angle rotation in radians. In reconstruction.json it comes with a translation,
both world to camera; in shots.geojson with the position of the camera. OpenCV's axes, z up where
positions were known. Focal lengths and principal points are shares of the longer side, the latter
from the middle. (OpenSfM: docs, "Reconstruction file format", and "Camera models"; ODM:
opendm/shots.py.) The scale is that of GPS, of which nothing says how good it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.datasets.exported_files import Point, radial_lens, shift_far, thin_cloud
from recon_cli.datasets.file_finder import FileFinder
from recon_cli.datasets.frame_table import UNUSABLE, Z_UP, FrameTable, LeftOutError
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_json

_RECONSTRUCTIONS = ("reconstruction.json", "opensfm/reconstruction.json")
_SHOTS = ("odm_report/shots.geojson", "shots.geojson")
_PERSPECTIVE = ("perspective", "simple_radial", "radial", "brown")
_FISHEYE = ("fisheye", "fisheye_opencv")

Shot = tuple[str, str, list[float], NDArray[np.float64]]  # name, camera, rotation, position


def is_opensfm(folder: Path) -> bool:
    """Returns whether a folder holds a reconstruction of OpenSfM or OpenDroneMap."""
    return _find(folder, _RECONSTRUCTIONS) is not None or (
        _find(folder, _SHOTS) is not None and (folder / "cameras.json").is_file())


def _find(folder: Path, names: Sequence[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_opensfm(folder: Path) -> PosedSet:
    """Returns the images of the largest reconstruction, and its points.

    InputError if no image is there; FormatError if a file is damaged.
    """
    path = _find(folder, _RECONSTRUCTIONS)
    cameras: Mapping[str, Any]
    if path is not None:
        value, notices = _largest(path)
        cameras, shots = value.get("cameras") or {}, _shots(value, path)
    else:
        path = _find(folder, _SHOTS)
        assert path is not None
        value, notices = {}, []
        cameras, shots = read_json(folder / "cameras.json", dict), _features(path)
    table = FrameTable(folder, pictures=folder / "images")
    finder = FileFinder(folder, [shot[0] for shot in shots])
    for name, camera, turn, position in shots:
        with table.frame(PurePosixPath(name).name):
            path = finder.find_photo(name)
            viewmat = table.pose(_pose, turn, position)
            table.add(PosedImage(path.name, path, _lens(cameras, camera, path), viewmat))
    table.rows.sort(key=lambda image: image.name)
    table.notices += [*notices, (
        "its scale is that of GPS or arbitrary, so its unit is not taken for a metre; "
        "--scale-between of recon sfm makes it one")]
    posed = replace(table.finish(), up=Z_UP)
    return shift_far(thin_cloud(posed, _list_points(value.get("points") or {})))


def _largest(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Returns the reconstruction with the most images, and a notice of the others."""
    models = [one for one in read_json(path, list)
              if isinstance(one, dict) and isinstance(one.get("shots"), dict)]
    if not models:
        raise FormatError(f"{path} holds no reconstruction.")
    best = max(models, key=lambda one: len(one["shots"]))
    others = sum(len(one["shots"]) for one in models if one is not best)
    return best, [f"{others} images of {len(models) - 1} other reconstructions, which did not "
                  "connect, are left out"] * (len(models) > 1)


def _shots(value: Mapping[str, Any], path: Path) -> list[Shot]:
    shots = []
    for name, shot in value["shots"].items():
        try:
            turn = [float(one) for one in shot["rotation"]]
            moved = np.array([float(one) for one in shot["translation"]])
            rotation = Rotation.from_rotvec(turn).as_matrix()
            shots.append((str(name), str(shot["camera"]), turn, -rotation.T @ moved))
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path}, shot {name}, has no pose.") from error
    return shots


def _features(path: Path) -> list[Shot]:
    """Returns the shots of OpenDroneMap's report."""
    value = read_json(path, dict)
    shots = []
    for feature in value.get("features") or []:
        try:
            properties = feature["properties"]
            shots.append((
                str(properties["filename"]), str(properties.get("camera", "")),
                [float(one) for one in properties["rotation"]],
                np.array([float(one) for one in properties["translation"]])))
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path} has a shot without a pose.") from error
    return shots


def _pose(turn: list[float], position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns camera to world [3, 4]; ValueError if the numbers are none of a rotation."""
    if len(turn) != 3 or position.shape != (3,) or not np.isfinite([*turn, *position]).all():
        raise ValueError("no pose")
    return np.column_stack([Rotation.from_rotvec(turn).as_matrix().T, position])


def _lens(cameras: Mapping[str, Any], name: str, image: Path) -> Lens:
    """Returns the lens of a camera; of the one that there is, if a shot names none."""
    camera = cameras.get(name)
    if camera is None and len(cameras) == 1:
        camera = next(iter(cameras.values()))
    try:
        assert isinstance(camera, dict)
        return make_opensfm_lens(camera, image)
    except (AssertionError, *UNUSABLE) as error:
        raise LeftOutError("whose camera is missing or of a kind that is not read") from error


def make_opensfm_lens(camera: Mapping[str, Any], image: Path) -> Lens:
    """Returns the lens of a camera of OpenSfM; ValueError if COLMAP has none like it."""
    kind = camera.get("projection_type", "perspective")
    size = int(camera.get("width") or 0), int(camera.get("height") or 0)
    if min(size) < 1:
        size = image_size(image)
    longer = max(size)

    def number(key: str) -> float:
        return float(camera.get(key) or 0.0)

    fx = number("focal_x") or number("focal")
    fy = number("focal_y") or fx
    inner = (fx * longer, fy * longer, size[0] / 2 + number("c_x") * longer,
             size[1] / 2 + number("c_y") * longer)
    radial = [number(f"k{at}") for at in range(1, 5)]
    if kind in _PERSPECTIVE:
        return radial_lens(size, inner, [*radial[:3], 0.0], (number("p1"), number("p2")),
                           str(image))
    if kind in _FISHEYE:
        return make_lens("OPENCV_FISHEYE", *size, (*inner, *radial), str(image))
    raise ValueError(f"{kind} is not read")


def _list_points(points: Mapping[str, Any]) -> list[Point]:
    """Returns the places and colours of points."""
    cloud: list[Point] = []
    for point in points.values():
        with suppress(*UNUSABLE):
            x, y, z = map(float, point["coordinates"])
            red, green, blue = map(float, point.get("color") or (128, 128, 128))
            cloud.append(((x, y, z), (red, green, blue)))
    return cloud
