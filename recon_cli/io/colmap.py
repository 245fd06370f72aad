"""COLMAP models of undistorted views: checked binary readers, and a writer by pycolmap."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.errors import FormatError, Hint, InputError
from recon_cli.io.calibration import rotation_matrix
from recon_cli.io.face_frames import read_face_frames
from recon_cli.scene.camera import MODELS, Camera, Lens, make_lens
from recon_cli.scene.scene import Scene, View, split_views
from recon_cli.workspace.paths import refuse_special

if TYPE_CHECKING:  # readers need neither pycolmap nor SciPy
    from recon_cli.io.colmap_library import pycolmap
    from recon_cli.scene.covisibility import Observations

# COLMAP's camera models by their ids, src/colmap/sensor/models.h and pycolmap 4.2's CameraModelId
_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
    "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE",
    "EUCM", "EQUIRECTANGULAR",
)
_HINT = Hint("sfm", again=True)


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
    for name, lens, viewmat in _read_views(sparse):
        camera = lens.pinhole(viewmat)
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


def read_pinholes(sparse: Path) -> dict[str, Lens]:
    """Returns the lens of each view of an undistorted model, by name."""
    return {name: lens for name, lens, _ in _read_views(sparse)}


def _read_views(sparse: Path) -> list[tuple[str, Lens, NDArray[np.float64]]]:
    """Returns the name, lens and [4, 4] world to camera of each view."""
    lenses = read_lenses(sparse / "cameras.bin")
    for number, lens in lenses.items():
        if lens.model != "PINHOLE":
            raise FormatError(
                f"{sparse / 'cameras.bin'} holds a camera {number} of the model {lens.model}, but "
                "only undistorted pinhole cameras can be trained on.", hint=_HINT)
    images = read_images(sparse / "images.bin")
    for name, camera_id, _ in images:
        if camera_id not in lenses:
            raise model_error(sparse, f"{name} has the unknown camera {camera_id}", _HINT)
    return [(name, lenses[camera_id], viewmat) for name, camera_id, viewmat in images]


def read_lenses(path: Path, *, hint: str | Hint = _HINT) -> dict[int, Lens]:
    """Returns the intrinsics of a cameras.bin by camera id."""
    reader = Reader(path, hint)
    lenses = {}
    for _ in range(reader.count(minimum=24)):
        camera_id, model, width, height = reader.take("<IiQQ")
        name = _MODELS[model] if 0 <= model < len(_MODELS) else str(model)
        params = reader.take(f"<{MODELS[name][1]}d") if name in MODELS else ()
        lenses[camera_id] = make_lens(name, width, height, params, f"{path}, camera {camera_id},")
    reader.end()
    return lenses


def read_images(
    path: Path, *, hint: str | Hint = _HINT
) -> list[tuple[str, int, NDArray[np.float64]]]:
    """Returns (name, camera id, [4, 4] world to camera) of each image of an images.bin."""
    images = []
    for _, name, camera_id, pose in _read_image_rows(path, hint):
        viewmat = pose_matrix(pose)
        if viewmat is None:
            raise model_error(path, f"no pose of {name}", hint)
        images.append((name, camera_id, viewmat))
    return images


def read_points(
    path: Path, *, hint: str | Hint = _HINT
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions [P, 3] and RGB colours [P, 3] of a points3D.bin, sorted by point id."""
    rows = [row for row, _ in _read_point_rows(path, hint)]
    positions = np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise model_error(path, "a point that is not finite", hint)
    return positions, np.array([row[4:7] for row in rows], np.uint8).reshape(-1, 3)


def read_visibility(sparse: Path) -> dict[str, NDArray[np.int64]]:
    """Returns the rows of the points that each view sees, by name; rows as in `read_points`.

    FormatError if the model is missing or damaged.
    """
    names, _, seen = read_observations(sparse)
    order = np.argsort(seen.view, kind="stable")
    ends = np.searchsorted(seen.view[order], np.arange(len(names) + 1))
    return {name: np.unique(seen.point[order[start:end]])
            for name, start, end in zip(names, ends[:-1], ends[1:], strict=True)}


def read_observations(
    sparse: Path,
) -> tuple[list[str], NDArray[np.float64], Observations]:
    """Returns the names of the views, the points [P, 3] and which view sees which point.

    Views are sorted by name, and points by their id, as `read_points` sorts them. FormatError if
    the model is missing or damaged.
    """
    names = {number: name for number, name, *_ in _read_image_rows(sparse / "images.bin", _HINT)}
    points = _read_point_rows(sparse / "points3D.bin", _HINT)
    rows = {number: row for row, number in enumerate(sorted(names, key=names.__getitem__))}
    if unknown := {number for _, track in points for number in track} - rows.keys():
        raise model_error(sparse, f"points of the unknown image {min(unknown)}", _HINT)
    views = np.array([rows[number] for _, track in points for number in track], np.int64)
    point = np.repeat(np.arange(len(points)), [len(track) for _, track in points])
    positions = np.array([row[1:4] for row, _ in points], np.float64).reshape(-1, 3)
    from recon_cli.scene.covisibility import Observations

    return sorted(names.values()), positions, Observations(views, point, len(names), len(points))


def _read_image_rows(
    path: Path, hint: str | Hint
) -> list[tuple[int, str, int, list[float]]]:
    """Returns id, name, camera id, and quaternion and translation of each image."""
    reader, images = Reader(path, hint), []
    for _ in range(reader.count(minimum=73)):
        number, *pose, camera_id = reader.take("<I7dI")
        images.append((number, reader.text(), camera_id, pose))
        reader.skip(24 * reader.count(minimum=24))  # x, y and point id of each observation
    reader.end()
    return images


def _read_point_rows(path: Path, hint: str | Hint) -> list[tuple[tuple[Any, ...], tuple[int, ...]]]:
    """Returns id, position and colour of each point, and the images of its track; by the ids."""
    reader, rows = Reader(path, hint), []
    for _ in range(reader.count(minimum=51)):
        row = reader.take("<Q3d3Bd")[:7]
        length = reader.count(minimum=8)  # image id and observation of each
        rows.append((row, reader.take(f"<{2 * length}I")[::2]))
    reader.end()
    return sorted(rows)


def write_part(
    sparse: Path, target: Path, names: Collection[str], points: NDArray[np.bool_]
) -> int:
    """Writes the views of these names into a new folder, with the `points` [P] that two see.

    Points that came without tracks count as seen.

    Points count in the order of their ids, as in `read_points`. Returns how many were written.
    """
    from recon_cli.io.colmap_library import pycolmap, write_model

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
    from recon_cli.io.colmap_library import pycolmap, write_model

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
    from recon_cli.io.colmap_library import pycolmap

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
    from recon_cli.io.colmap_library import pycolmap

    prior = pycolmap.PosePrior()
    prior.corr_data_id = data_id
    prior.position = camera.center
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    if deviation is not None:
        prior.position_covariance = np.eye(3) * deviation**2
    if up is not None:
        prior.gravity = camera.viewmat[:3, :3] @ -up
    return prior


def _model(views: Sequence[tuple[str, Camera]]) -> pycolmap.Reconstruction:
    from recon_cli.io.colmap_library import pycolmap

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
