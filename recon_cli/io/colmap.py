"""COLMAP's binary models, as far as a scene needs them: one pinhole camera a view, and points.

Read here byte by byte rather than by pycolmap, which does not notice a cameras.bin cut short, does
not come back from a points3D.bin cut short, and is native code in the process that trains.
Observations and tracks are skipped. The layout is that of COLMAP's src/colmap/scene/
reconstruction_io; rigs.bin and frames.bin, which newer models have beside it, say nothing more
where each image has a camera of its own place.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.errors import FormatError
from recon_cli.scene import Camera, Scene, View
from recon_cli.scene.scene import split_views

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
            raise _damaged(undistorted / "sparse", f"{name} has the unknown camera {camera_id}")
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
        raise _damaged(undistorted / "sparse", f"{len(views)} views and {len(points)} points")
    missing = sorted(held_out - {view.name for view in views})
    return Scene(train, chosen, test, tuple(missing), points, colors)


def read_pinholes(sparse: Path) -> dict[str, Pinhole]:
    """Returns the camera of each view of an undistorted model, by name.

    Raises:
        FormatError: the model is missing or damaged, or not of pinhole cameras.
    """
    cameras = read_cameras(sparse / "cameras.bin")
    views = read_images(sparse / "images.bin")
    missing = [name for name, camera_id, _ in views if camera_id not in cameras]
    if missing:
        raise _damaged(sparse, f"{missing[0]} has an unknown camera")
    return {name: cameras[camera_id] for name, camera_id, _ in views}


def read_cameras(path: Path) -> dict[int, Pinhole]:
    """Returns the cameras of a cameras.bin by id.

    Raises:
        FormatError: the file is missing or damaged, or holds a camera that is no pinhole.
    """
    reader = _Reader(path)
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


def read_images(path: Path) -> list[tuple[str, int, NDArray[np.float64]]]:
    """Returns (name, camera id, [4, 4] world to camera) of each image of an images.bin.

    Raises:
        FormatError: the file is missing or damaged.
    """
    reader = _Reader(path)
    images = []
    for _ in range(reader.count(minimum=73)):
        _, *pose, camera_id = reader.take("<I7dI")
        name = reader.text()
        reader.skip(24 * reader.count(minimum=24))  # x, y and point id of each observation
        if not np.isfinite(pose).all() or not any(pose[:4]):
            raise _damaged(path, f"no pose of {name}")
        viewmat = np.eye(4)
        viewmat[:3, :3] = _rotation(np.array(pose[:4]))
        viewmat[:3, 3] = pose[4:]
        images.append((name, camera_id, viewmat))
    reader.end()
    return images


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions [P, 3] and RGB colours [P, 3] of a points3D.bin, sorted by point id.

    Raises:
        FormatError: the file is missing or damaged.
    """
    reader = _Reader(path)
    rows = []
    for _ in range(reader.count(minimum=51)):
        rows.append(reader.take("<Q3d3Bd")[:7])
        reader.skip(8 * reader.count(minimum=8))  # image id and observation of each in the track
    reader.end()
    rows.sort()
    positions = np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise _damaged(path, "a point that is not finite")
    return positions, np.array([row[4:7] for row in rows], np.uint8).reshape(-1, 3)


class _Reader:
    """Takes values off a file, and notices when it ends too soon or too late."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0
        try:
            self._data = path.read_bytes()
        except FileNotFoundError as error:
            raise FormatError(f"{path} is missing.", hint=_HINT) from error

    def take(self, layout: str) -> tuple[Any, ...]:
        """Returns the next values, laid out as `struct` says."""
        start = self._at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._data, start)

    def count(self, *, minimum: int) -> int:
        """Returns the next value, a number of entries of at least `minimum` bytes each."""
        (value,) = self.take("<Q")
        if value * minimum > len(self._data) - self._at:
            raise _damaged(self._path, f"{value} entries promised")
        return int(value)

    def text(self) -> str:
        """Returns the next text, which ends with a zero byte."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise _damaged(self._path, "a name without an end")
        value, self._at = self._data[self._at:end], end + 1
        return value.decode(errors="replace")

    def skip(self, size: int) -> None:
        """Passes over `size` bytes."""
        if self._at + size > len(self._data):
            raise _damaged(self._path, f"only {len(self._data)} bytes")
        self._at += size

    def end(self) -> None:
        """Raises FormatError when something is left."""
        if self._at != len(self._data):
            raise _damaged(self._path, f"{len(self._data) - self._at} bytes too many")


def _rotation(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the [3, 3] rotation of a quaternion, wxyz, of any length but zero."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


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


def _damaged(path: Path, what: str) -> FormatError:
    return FormatError(f"{path} is not a whole COLMAP model: {what}.", hint=_HINT)
