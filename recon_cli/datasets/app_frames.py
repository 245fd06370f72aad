"""What readers of scanning apps share: frames by number, poses of phones, and frames left out.

An app stops at any moment, so that single frames may lack a file or a pose. Those are left out and
counted by reason; a set without any frame that can be used is refused.
"""

from __future__ import annotations

import csv
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.datasets.posed import PosedImage, PosedSet, find_images
from recon_cli.errors import FormatError, InputError, format_count
from recon_cli.io.calibration import viewmat_from_pose
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_json, read_text

Y_UP = (0.0, 1.0, 0.0)  # of ARKit's and Unity's worlds
Z_UP = (0.0, 0.0, 1.0)
PICTURES = (".jpg", ".jpeg", ".png")
HEAD_LINES = 3  # of a table, one of which is the header
_UNIT_LENGTH = 1e-2  # by which a quaternion of decimals may miss the length of 1
_OFF_CENTRE = 0.2  # of the image's side, by which a principal point may miss the middle
_RATIOS = sorted({a / b for a in range(1, 9) for b in range(1, 9)})  # of resized images
# Nearer to 1, a principal point that is off by one ratio along both sides may be a lens'.
_LEAST_RATIO = 1.25
_RATIO_SLACK = 0.06  # by which a principal point may miss the middle, as a share
_MOVED = 1e-9  # poses that differ by less are one and the same


class LeftOut:
    """Counts the frames that a reader leaves out, by reason."""

    def __init__(self) -> None:
        self._names: dict[str, list[str]] = {}
        self._scaled: dict[float, list[str]] = {}

    def add(self, name: str, reason: str) -> None:
        """Adds a frame; `reason` goes on after "frames"."""
        self._names.setdefault(reason, []).append(name)

    @property
    def count(self) -> int:
        """How many frames there are."""
        return sum(map(len, self._names.values()))

    def notices(self) -> tuple[str, ...]:
        """Returns one notice for each reason, and for each factor of intrinsics."""
        return tuple(
            f"left out: {format_count(len(names), 'frame')} {reason}, the first is {names[0]}"
            for reason, names in self._names.items()) + tuple(
            f"the intrinsics of {format_count(len(names), 'frame')} were scaled by {factor:.4g}: "
            f"they are for images of another size, the first is {names[0]}"
            for factor, names in self._scaled.items())

    def pose(
        self, name: str, make: Callable[..., Any], *values: Any, opengl: bool
    ) -> NDArray[np.float64] | None:
        """Returns [4, 4] world to camera of what `make(*values)` gives, None where unusable."""
        try:
            return viewmat_from_pose(make(*values), name, opengl=opengl)
        except (FormatError, KeyError, TypeError, ValueError, IndexError):
            self.add(name, "whose pose is missing, not finite or not rigid")
            return None

    def lens(
        self, name: str, size: tuple[int, int], make: Callable[..., Sequence[Any]], *values: Any
    ) -> Lens | None:
        """Returns a PINHOLE of fx, fy, cx, cy by `make(*values)`, None where unusable.

        Intrinsics of images of another size are scaled, and counted.
        """
        try:
            params, factor = fit_intrinsics(make(*values), size, name)
            found = make_lens("PINHOLE", *size, params, name)
        except (FormatError, KeyError, TypeError, ValueError, IndexError, OverflowError):
            self.add(name, f"whose intrinsics are missing or not those of {size[0]}x{size[1]} "
                     "pixels")
            return None
        if factor != 1:
            self._scaled.setdefault(factor, []).append(name)
        return found

    def json(self, path: Path) -> dict[str, Any] | None:
        """Returns the object in a frame's file, None where it is cut short or damaged."""
        try:
            value: dict[str, Any] = read_json(path, dict, finite=False)
            return value
        except FormatError:
            self.add(path.name, "whose file cannot be read as JSON")
            return None


def pose_from_quat(xyzw: Iterable[Any], position: Iterable[Any]) -> NDArray[np.float64]:
    """Returns [4, 4] of a unit quaternion x y z w and a position; ValueError if it is none."""
    quat = np.array([float(one) for one in xyzw])
    if not abs(np.linalg.norm(quat) - 1) < _UNIT_LENGTH:  # NaN too
        raise ValueError("not a unit quaternion")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quat).as_matrix()
    pose[:3, 3] = [float(one) for one in position]
    return pose


def pose_from_unity(xyzw: Iterable[Any], position: Iterable[Any]) -> NDArray[np.float64]:
    """Returns [4, 4] camera to world, OpenCV's axes, y up, of Unity's left-handed world and camera.

    ValueError as for `pose_from_quat`.
    """
    world, camera = np.diag([1.0, 1, -1, 1]), np.diag([1.0, -1, 1, 1])
    return np.asarray(world @ pose_from_quat(xyzw, position) @ camera)


def tracked_set(
    layout: str, listed: Sequence[PosedImage], folder: Path, left_out: LeftOut, *,
    photos: str, up: tuple[float, float, float] | None = Y_UP,
    missing: Sequence[str] = (), bare: int = 0,
) -> PosedSet:
    """Returns the frames that a phone or headset tracked, in metres.

    `photos` are its pictures for a hint, below the folder; `bare` counts poses that have none. With
    `up` None, up is found from the scene. InputError if no frame has an image and a pose, or all
    poses are one and the same.
    """
    hint = ("Give the pictures alone, so that the cameras are found from them: recon ingest "
            f"{photos}")
    if not listed:
        told = "; ".join(left_out.notices())
        raise InputError(
            f"{folder} has no frame with a pose" + (f": {told}." if told else "."), hint=hint)
    refuse_one_pose(listed, folder, hint)
    posed = find_images(layout, listed, folder, missing=missing)
    return replace(
        posed, metric=True, sequence=True, up=up, find_up=up is None, accuracy="tracked",
        notices=(*left_out.notices(), *posed.notices, *(
            [f"without a picture: {bare} of its poses"] if bare else [])))


def refuse_one_pose(listed: Sequence[PosedImage], folder: Path, hint: str) -> None:
    """Raises InputError for frames that all have one pose: the app did not track the camera."""
    poses = np.stack([image.viewmat for image in listed])
    if len(poses) > 1 and np.abs(poses - poses[0]).max() < _MOVED:
        raise InputError(
            f"All {len(poses)} poses of {folder} are the same: the camera was not tracked, as in "
            "recordings of a front camera.", hint=hint)


def quoted(path: Path) -> str:
    """Returns a path as it is typed in a shell."""
    return shlex.quote(str(path))


def list_numbered(
    folder: Path, suffixes: Sequence[str], prefix: str = ""
) -> dict[int, Path]:
    """Returns the files of a folder that are called by a number, in its order.

    Copies such as `12(3).jpg` are no number; of 1.jpg and 0001.jpg the first by name counts.
    """
    if not folder.is_dir():
        return {}
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = path.stem.removeprefix(prefix)
        if (path.stem.startswith(prefix) and path.suffix.lower() in suffixes
                and number.isascii() and number.isdecimal()):
            found.setdefault(int(number), path)
    return dict(sorted(found.items()))


def read_csv(path: Path, needed: Sequence[str]) -> list[dict[str, str]]:
    """Returns the rows of a table with a header, by its names in small letters.

    Comments may stand above the header. A line that is cut short lacks its last columns.
    FormatError if a needed column is missing.
    """
    try:
        lines = [line for line in read_text(path).lstrip("\ufeff").splitlines() if line.strip()]
        table = [[value.strip() for value in row]
                 for row in csv.reader(lines, skipinitialspace=True)]
    except (OSError, ValueError, csv.Error) as error:
        raise FormatError(
            f"{path} cannot be read: {error}.", hint="Copy the file again.") from error
    heads = [column_names(row) for row in table[:HEAD_LINES]]
    at = next((at for at, names in enumerate(heads) if set(needed) <= set(names)), None)
    if at is None:
        names = heads[0] if heads else []
        missing = [name for name in needed if name not in names]
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(names) or 'none'}.",
            hint="Copy the file again, or export it again.")
    return [dict(zip(heads[at], row, strict=False)) for row in table[at + 1:]]


def column_names(row: Sequence[str]) -> list[str]:
    """Returns the names of the columns of a header, in small letters and without its mark."""
    return [name.strip().lstrip("#").strip().lower() for name in row]


def numbers(row: Mapping[str, str], names: Sequence[str]) -> list[float]:
    """Returns numbers of a row; KeyError or ValueError where one is missing."""
    return [float(row[name]) for name in names]


def fit_intrinsics(
    params: Sequence[float], size: tuple[int, int], where: str
) -> tuple[tuple[float, float, float, float], float]:
    """Returns fx, fy, cx, cy for images of a size, and by which factor they were scaled.

    If the principal point lies off the middle by one simple factor along both sides, they are those
    of a larger or smaller image. FormatError if they are those of no such size.
    """
    fx, fy, cx, cy = map(float, params)
    width, height = size
    if not all(np.isfinite([fx, fy, cx, cy])) or min(fx, fy, cx, cy) <= 0:
        raise FormatError(f"{where} holds no intrinsics of a camera: {fx:g} {fy:g} {cx:g} {cy:g}.")
    across, down = width / (2 * cx), height / (2 * cy)
    ratio = min(_RATIOS, key=lambda one: abs(np.log(one / np.sqrt(across * down))))
    fits = max(abs(across / ratio - 1), abs(down / ratio - 1)) <= _RATIO_SLACK
    if fits and max(ratio, 1 / ratio) >= _LEAST_RATIO:
        return (fx * ratio, fy * ratio, cx * ratio, cy * ratio), float(ratio)
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _OFF_CENTRE:
        raise FormatError(
            f"{where} has the principal point {cx:.0f}, {cy:.0f}, but the images have "
            f"{width}x{height} pixels: it is that of images of another shape.",
            hint="Export images and intrinsics at one size.")
    return (fx, fy, cx, cy), 1.0
