"""COLMAP's binary models, as far as a scene needs them: one pinhole camera a view, and points.

Read here byte by byte rather than by pycolmap, which does not notice a cameras.bin cut short, does
not come back from a points3D.bin cut short, and is native code in the process that trains.
Observations and tracks are skipped. The layout is that of COLMAP's src/colmap/scene/
reconstruction_io; rigs.bin and frames.bin, which newer models have beside it, say nothing more
where each image has a camera of its own place.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.errors import FormatError
from recon_cli.io.colmap_bytes import Reader, damaged, rigid
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View, split_views

_PINHOLE = 1  # COLMAP's id of the model with fx, fy, cx, cy
_HINT = "Run `recon sfm --again`."


@dataclass(frozen=True)
class Pinhole:
    """The inner side of a camera, in pixels; the centre of the first pixel lies at 0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def read_scene(
    undistorted: Path,
    *,
    held_out: frozenset[str],
    validation: float,
    denoised: Path | None = None,
) -> Scene:
    """Returns the registered views and the points of an undistorted model.

    Args:
        undistorted: folder with images/ and sparse/, as COLMAP's image_undistorter lays it out,
            and masks/ where frames are masked: a gray image of the frame's name for each of them.
        held_out: names of the frames kept for the score, registered or not.
        validation: share of the other views that is set apart.
        denoised: folder of the denoised twins; None for the denoised/ beside images/.

    Raises:
        FormatError: the model is missing, damaged, empty or not of pinhole cameras, or an image is
            missing or it or its mask is not of its camera's size.
    """
    cameras = read_cameras(undistorted / "sparse" / "cameras.bin")
    twins = undistorted / "denoised" if denoised is None else denoised
    views = []
    for name, camera_id, viewmat in read_images(undistorted / "sparse" / "images.bin"):
        if camera_id not in cameras:
            raise damaged(
                undistorted / "sparse", f"{name} has the unknown camera {camera_id}", _HINT)
        inner = cameras[camera_id]
        camera = Camera(
            inner.width, inner.height, inner.fx, inner.fy, inner.cx, inner.cy, viewmat)
        mask = undistorted / "masks" / name
        view = View(name, camera, undistorted / "images" / name, twins / name,
                    mask if mask.exists() else None)
        for path in filter(None, (view.original, view.denoised, view.mask)):
            _check_size(path, camera)
        views.append(view)
    points, colors = read_points(undistorted / "sparse" / "points3D.bin")
    train, chosen, test = split_views(views, held_out, validation=validation)
    if not views or not len(points):
        raise damaged(undistorted / "sparse", f"{len(views)} views and {len(points)} points", _HINT)
    missing = sorted(held_out - {view.name for view in views})
    error = mean_point_error(undistorted / "sparse" / "points3D.bin")
    return Scene(train, chosen, test, tuple(missing), points, colors, error)


def read_pinholes(sparse: Path) -> dict[str, Pinhole]:
    """Returns the camera of each view of an undistorted model, by name.

    Raises:
        FormatError: the model is missing or damaged, or not of pinhole cameras.
    """
    cameras = read_cameras(sparse / "cameras.bin")
    views = read_images(sparse / "images.bin")
    missing = [name for name, camera_id, _ in views if camera_id not in cameras]
    if missing:
        raise damaged(sparse, f"{missing[0]} has an unknown camera", _HINT)
    return {name: cameras[camera_id] for name, camera_id, _ in views}


def read_cameras(path: Path) -> dict[int, Pinhole]:
    """Returns the cameras of a cameras.bin by id.

    Raises:
        FormatError: the file is missing or damaged, or holds a camera that is no pinhole.
    """
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
    path: Path, *, hint: str = _HINT
) -> list[tuple[str, int, NDArray[np.float64]]]:
    """Returns (name, camera id, [4, 4] world to camera) of each image of an images.bin.

    Raises:
        FormatError: the file is missing or damaged.
    """
    reader = Reader(path, hint)
    images = []
    for _ in range(reader.count(minimum=73)):
        _, *pose, camera_id = reader.take("<I7dI")
        name = reader.text()
        reader.skip(24 * reader.count(minimum=24))  # x, y and point id of each observation
        viewmat = rigid(pose)
        if viewmat is None:
            raise damaged(path, f"no pose of {name}", hint)
        images.append((name, camera_id, viewmat))
    reader.end()
    return images


def read_points(
    path: Path, *, hint: str = _HINT
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions [P, 3] and RGB colours [P, 3] of a points3D.bin, sorted by point id.

    Raises:
        FormatError: the file is missing or damaged.
    """
    reader = Reader(path, hint)
    rows = []
    for _ in range(reader.count(minimum=51)):
        rows.append(reader.take("<Q3d3Bd")[:7])
        reader.skip(8 * reader.count(minimum=8))  # image id and observation of each in the track
    reader.end()
    rows.sort()
    positions = np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise damaged(path, "a point that is not finite", hint)
    return positions, np.array([row[4:7] for row in rows], np.uint8).reshape(-1, 3)


def mean_point_error(path: Path) -> float | None:
    """Returns the mean reprojection error of a points3D.bin in pixels of its images.

    None where no point has any: depth maps give points that were never matched.

    Raises:
        FormatError: the file is missing or damaged.
    """
    reader = Reader(path, _HINT)
    errors = []
    for _ in range(reader.count(minimum=51)):
        errors.append(float(reader.take("<Q3d3Bd")[7]))
        reader.skip(8 * reader.count(minimum=8))
    known = [error for error in errors if error > 0]
    return float(np.mean(known)) if known else None


def _check_size(path: Path, camera: Camera) -> None:
    """Raises FormatError unless an image is there and as large as its camera says."""
    try:
        with Image.open(path) as image:  # reads the header only
            size = image.size
    except (FileNotFoundError, UnidentifiedImageError) as error:
        raise FormatError(f"{path} is missing or no image.", hint=_HINT) from error
    if size != (camera.width, camera.height):
        raise FormatError(
            f"{path} is {size[0]}x{size[1]} pixels, but its camera {camera.width}x{camera.height}.",
            hint=_HINT)
