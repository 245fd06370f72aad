"""COLMAP models of undistorted views: checked binary readers, and a writer by pycolmap."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.errors import FormatError, Hint, InputError
from recon_cli.io.calibration import rotation_matrix
from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.io.face_frames import read_face_frames
from recon_cli.scene.camera import Camera, Lens
from recon_cli.scene.covisibility import Observations
from recon_cli.scene.scene import Scene, View, split_views
from recon_cli.workspace.paths import refuse_special

_PINHOLE = 1  # COLMAP's id of the model with fx, fy, cx, cy
_HINT = Hint("sfm", again=True)


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics in pixels; the centre of the first pixel is at 0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def read_scene(
    undistorted: Path, *, held_out: frozenset[str], validation: float | frozenset[str],
    denoised: Path | None = None, sparse: Path | None = None,
) -> Scene:
    """Returns the registered views and the points of an undistorted model.

    `undistorted` has images/ and sparse/, as COLMAP's image_undistorter lays them out, and masks/
    with a gray image of the name of each masked frame; `denoised` defaults to denoised/ in it, and
    `sparse` to sparse/, of which it may be a part.
    `held_out` are names of frames; `validation` are those of the validation views, or their share
    of the other frames.
    FormatError if the model is missing, damaged, empty or not of pinhole cameras, or an image or
    its mask is missing or not of its camera's size.
    """
    sparse = undistorted / "sparse" if sparse is None else sparse
    twins = undistorted / "denoised" if denoised is None else denoised
    views, frames = [], read_face_frames(undistorted)
    for name, inner, viewmat in _read_views(sparse):
        camera = Camera(inner.width, inner.height, inner.fx, inner.fy, inner.cx, inner.cy, viewmat)
        mask = undistorted / "masks" / name
        view = View(name, camera, undistorted / "images" / name, twins / name,
                    mask if mask.exists() else None, frames.get(name))
        for path in filter(None, (view.original, view.denoised, view.mask)):
            _check_size(path, camera)
        views.append(view)
    points, colors = read_points(sparse / "points3D.bin")
    train, chosen, test = split_views(views, held_out, validation=validation)
    if not views or not len(points):
        raise model_error(sparse, f"{len(views)} views and {len(points)} points", _HINT)
    missing = sorted(held_out - {view.frame for view in views})
    return Scene(train, chosen, test, tuple(missing), points, colors, sparse=sparse)


def read_pinholes(sparse: Path) -> dict[str, Pinhole]:
    """Returns the camera of each view of an undistorted model, by name."""
    return {name: pinhole for name, pinhole, _ in _read_views(sparse)}


def _read_views(sparse: Path) -> list[tuple[str, Pinhole, NDArray[np.float64]]]:
    """Returns the name, camera and [4, 4] world to camera of each view."""
    cameras = read_cameras(sparse / "cameras.bin")
    images = read_images(sparse / "images.bin")
    for name, camera_id, _ in images:
        if camera_id not in cameras:
            raise model_error(sparse, f"{name} has the unknown camera {camera_id}", _HINT)
    return [(name, cameras[camera_id], viewmat) for name, camera_id, viewmat in images]


def read_cameras(path: Path) -> dict[int, Pinhole]:
    """Returns the cameras of a cameras.bin by id; FormatError unless all are pinholes."""
    reader = Reader(path, _HINT)
    cameras = {}
    for _ in range(reader.count(minimum=24)):
        camera_id, model, width, height = reader.take("<IiQQ")
        if model != _PINHOLE:
            raise FormatError(
                f"{path} holds a camera of COLMAP's model {model}, but only undistorted pinhole "
                f"cameras (model {_PINHOLE}) can be trained on.", hint=_HINT)
        fx, fy, cx, cy = reader.take("<4d")
        cameras[camera_id] = Pinhole(width, height, fx, fy, cx, cy)
    reader.end()
    return cameras


def read_images(
    path: Path, *, hint: str | Hint = _HINT
) -> list[tuple[str, int, NDArray[np.float64]]]:
    """Returns (name, camera id, [4, 4] world to camera) of each image of an images.bin."""
    reader = Reader(path, hint)
    images = []
    for _ in range(reader.count(minimum=73)):
        _, *pose, camera_id = reader.take("<I7dI")
        name = reader.text()
        reader.skip(24 * reader.count(minimum=24))  # x, y and point id of each observation
        viewmat = pose_matrix(pose)
        if viewmat is None:
            raise model_error(path, f"no pose of {name}", hint)
        images.append((name, camera_id, viewmat))
    reader.end()
    return images


def read_points(
    path: Path, *, hint: str | Hint = _HINT
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions [P, 3] and RGB colours [P, 3] of a points3D.bin, sorted by point id."""
    rows = sorted(row[:7] for row in _read_point_rows(path, hint))
    positions = np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise model_error(path, "a point that is not finite", hint)
    return positions, np.array([row[4:7] for row in rows], np.uint8).reshape(-1, 3)


def read_visibility(sparse: Path) -> dict[str, NDArray[np.int64]]:
    """Returns the rows of the points that each view sees, by name; rows as in `read_points`.

    FormatError if the model is missing or damaged.
    """
    reader = Reader(sparse / "images.bin", _HINT)
    names = {}
    for _ in range(reader.count(minimum=73)):
        number = reader.take("<I7dI")[0]
        names[number] = reader.text()
        reader.skip(24 * reader.count(minimum=24))
    reader.end()
    reader = Reader(sparse / "points3D.bin", _HINT)
    ids, tracks = [], []
    for _ in range(reader.count(minimum=51)):
        ids.append(reader.take("<Q3d3Bd")[0])
        length = reader.count(minimum=8)
        tracks.append(np.array(reader.take(f"<{2 * length}I"), np.int64)[::2])
    reader.end()
    order = np.argsort(ids, kind="stable")
    rows = np.repeat(np.arange(len(ids)), [len(tracks[i]) for i in order])
    views = np.concatenate([np.empty(0, np.int64), *(tracks[i] for i in order)])
    by_view = np.argsort(views, kind="stable")
    rows, views = rows[by_view], views[by_view]
    return {name: np.unique(rows[slice(*np.searchsorted(views, [number, number + 1]))])
            for number, name in names.items()}


def _read_point_rows(path: Path, hint: str | Hint) -> list[tuple[Any, ...]]:
    """Returns id, position, colour and error of each point."""
    reader = Reader(path, hint)
    rows = []
    for _ in range(reader.count(minimum=51)):
        rows.append(reader.take("<Q3d3Bd"))
        reader.skip(8 * reader.count(minimum=8))  # image id and observation of each in the track
    reader.end()
    return rows


def read_observations(
    sparse: Path,
) -> tuple[list[str], NDArray[np.float64], Observations]:
    """Returns the names of the views, the points [P, 3] and which view sees which point.

    Views are sorted by name, and points by their id, as `read_points` sorts them.
    """
    model = pycolmap.Reconstruction(sparse)
    names = sorted(model.image(number).name for number in model.reg_image_ids())
    rows = {name: row for row, name in enumerate(names)}
    views = {number: rows[model.image(number).name] for number in model.reg_image_ids()}
    ids = sorted(model.points3D)
    seen = [(views[element.image_id], row) for row, number in enumerate(ids)
            for element in model.point3D(number).track.elements]
    view, point = np.array(seen, np.int64).reshape(-1, 2).T
    points = np.array([model.point3D(number).xyz for number in ids]).reshape(-1, 3)
    return names, points, Observations(view, point, len(names), len(ids))


def write_part(
    sparse: Path, target: Path, names: Collection[str], points: NDArray[np.bool_]
) -> int:
    """Writes the views of these names into a new folder, with the `points` [P] that two see.

    Points that came without tracks count as seen.

    Points count in the order of their ids, as in `read_points`. Returns how many were written.
    """
    model = pycolmap.Reconstruction(sparse)
    keep = dict(zip(sorted(model.points3D), points.tolist(), strict=True))
    tracked = model.compute_num_observations() > 0
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        if image.name not in names:
            model.deregister_frame(image.frame_id)
    for number in sorted(model.points3D):
        lost = tracked and model.point3D(number).track.length() < 2
        if lost or not keep[number]:
            model.delete_point3D(number)
    target.mkdir(parents=True)
    write_model(model, target)
    return int(model.num_points3D())


def _check_size(path: Path, camera: Camera) -> None:
    """Raises FormatError unless an image exists and has the size of its camera."""
    try:
        with Image.open(path) as image:  # reads the header only
            size = image.size
    except (FileNotFoundError, UnidentifiedImageError) as error:
        raise FormatError(f"{path} is missing or no image.", hint=_HINT) from error
    if size != (camera.width, camera.height):
        raise FormatError(
            f"{path} is {size[0]}x{size[1]} pixels, but its camera {camera.width}x{camera.height}.",
            hint=_HINT)


def write_colmap(
    folder: Path,
    views: Sequence[tuple[str, Camera]],
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
) -> None:
    """Writes a model of pinhole cameras into a new or empty folder, atomically.

    Views are names below the folder of images, with their cameras; equal intrinsics share one. No
    observations are written. InputError if there are no views, or the folder holds something.
    """
    if not views:
        raise InputError("There are no cameras to write.", hint=Hint("sfm", then=" first"))
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty.", hint="Name another folder, or remove it.")
    model = _model(views)
    for point, color in zip(points, colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    partial = folder.with_name(f".{folder.name}.tmp{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        write_model(model, partial)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_priors(
    path: Path, views: Sequence[tuple[str, Camera]], *, deviation: float | None,
    up: NDArray[np.float64] | None,  # [3] unit vector in the world
) -> None:
    """Writes a COLMAP database of the cameras, with their places and gravity as priors.

    `deviation` is the standard deviation of a place in world units; None leaves it to COLMAP.
    Gravity points down and is in the axes of the camera. Views are as in `write_colmap`.
    """
    model = _model(views)
    partial = path.with_name(f".{path.name}.tmp{os.getpid()}")
    partial.unlink(missing_ok=True)
    try:
        with pycolmap.Database.open(str(partial)) as database:
            for camera in model.cameras.values():
                database.write_camera(camera, use_camera_id=True)
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for number, (_, camera) in enumerate(views, start=1):
                image = model.image(number)
                database.write_frame(model.frame(image.frame_id), use_frame_id=True)
                database.write_image(image, use_image_id=True)
                database.write_pose_prior(_prior(image.data_id, camera, deviation, up))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _prior(
    data_id: Any, camera: Camera, deviation: float | None, up: NDArray[np.float64] | None
) -> pycolmap.PosePrior:
    prior = pycolmap.PosePrior()
    prior.corr_data_id = data_id
    prior.position = camera.center
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    if deviation is not None:
        prior.position_covariance = np.eye(3) * deviation**2
    if up is not None:
        prior.gravity = camera.viewmat[:3, :3] @ -up
    return prior


def project(lens: Lens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the pixels [M, 2] of points [M, 3] in a camera's axes, all before it."""
    camera = pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=lens.params)
    return np.asarray(camera.img_from_cam(points))


def _model(views: Sequence[tuple[str, Camera]]) -> pycolmap.Reconstruction:
    model, ids = pycolmap.Reconstruction(), dict[tuple[float, ...], int]()
    for number, (name, camera) in enumerate(views, start=1):
        inner = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        if inner not in ids:
            ids[inner] = len(ids) + 1
            model.add_camera_with_trivial_rig(pycolmap.Camera(
                camera_id=ids[inner], model="PINHOLE", width=camera.width, height=camera.height,
                params=inner[2:]))
        model.add_image_with_trivial_frame(
            pycolmap.Image(image_id=number, name=name, camera_id=ids[inner]),
            pycolmap.Rigid3d(camera.viewmat[:3]))
    return model


class Reader:
    """Reads values from a binary file, and refuses one that ends too soon or too late."""

    def __init__(self, path: Path, hint: str | Hint) -> None:
        self._path = path
        self._hint = hint
        self._at = 0
        refuse_special(path)
        try:
            self._data = path.read_bytes()
        except FileNotFoundError as error:
            raise FormatError(f"{path} is missing.", hint=hint) from error

    def take(self, layout: str) -> tuple[Any, ...]:
        """Returns the next values, laid out as `struct` says."""
        start = self._at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._data, start)

    def count(self, *, minimum: int) -> int:
        """Returns the next value, a number of entries of at least `minimum` bytes each."""
        (value,) = self.take("<Q")
        if value * minimum > len(self._data) - self._at:
            raise model_error(self._path, f"{value} entries promised", self._hint)
        return int(value)

    def text(self) -> str:
        """Returns the next text, which ends with a zero byte."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise model_error(self._path, "a name without an end", self._hint)
        value, self._at = self._data[self._at:end], end + 1
        return value.decode(errors="replace")

    def skip(self, size: int) -> None:
        """Skips `size` bytes."""
        if self._at + size > len(self._data):
            raise model_error(self._path, f"only {len(self._data)} bytes", self._hint)
        self._at += size

    def end(self) -> None:
        """Raises FormatError if bytes are left."""
        if self._at != len(self._data):
            rest = len(self._data) - self._at
            raise model_error(self._path, f"{rest} bytes too many", self._hint)


def pose_matrix(pose: Sequence[float]) -> NDArray[np.float64] | None:
    """Returns [4, 4] of a quaternion wxyz and a translation; None if they are not a pose."""
    if not np.isfinite(pose).all() or not any(pose[:4]):
        return None
    quat = np.array(pose[:4])
    quat = quat / np.abs(quat).max()  # so that squares stay finite
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(quat / np.linalg.norm(quat))
    matrix[:3, 3] = pose[4:]
    return matrix


def model_error(path: Path, fault: str, hint: str | Hint) -> FormatError:
    """Returns the error for a damaged file."""
    return FormatError(f"{path} is not a complete COLMAP model: {fault}.", hint=hint)
