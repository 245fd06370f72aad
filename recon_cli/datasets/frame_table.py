"""The table of the frames of a data set, which every reader fills: one row a frame.

A reader pairs pictures with poses, lenses and depth by name, number or nearest time, and adds a
row for each. Programs stop at any moment, so that single frames may lack a file or a pose: those
are left out and counted by reason. `FrameTable.finish` keeps the rows whose picture exists, each
with a lens of its size; a set without any frame that can be used is refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.frame_files import fit_intrinsics, quoted
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size, is_file
from recon_cli.errors import FormatError, InputError, command_line, format_count
from recon_cli.io.calibration import viewmat_from_pose
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace.atomic import read_json

Y_UP = (0.0, 1.0, 0.0)  # of ARKit's and Unity's worlds
Z_UP = (0.0, 0.0, 1.0)
_MOVED = 1e-9  # poses that differ by less are one and the same
# What a reader of numbers raises where one is missing or of another kind.
UNUSABLE = (FormatError, KeyError, TypeError, ValueError, IndexError, OverflowError)
Item = TypeVar("Item")


class LeftOutError(Exception):
    """A frame cannot be used; its text continues a sentence after "frames"."""


class MissingPictureError(LeftOutError):
    """A frame has no picture."""


def nearest(items: Mapping[float, Item], key: float, within: float) -> Item | None:
    """Returns the item whose key, such as a time, is nearest; None where none is that near."""
    if key in items:
        return items[key]
    near = min(items, key=lambda one: (abs(one - key), one), default=None)
    return items[near] if near is not None and abs(near - key) <= within else None


class FrameTable:
    """The frames of a data set, in its order, and those that are left out."""

    def __init__(
        self, folder: Path, *, pictures: Path | str = "", opengl: bool = False
    ) -> None:
        """Opens an empty table.

        `folder` is that of the set and `pictures` what to give instead, without poses, for
        messages. With `opengl` poses have OpenGL's camera axes, else OpenCV's.
        """
        self.rows: list[PosedImage] = []
        self.missing: list[str] = []  # names of pictures that the set lists, and that are not there
        self.notices: list[str] = []
        self._folder, self._opengl = folder, opengl
        self._pictures = quoted(pictures or folder)
        self._name = ""
        self._left_out: dict[str, list[str]] = {}
        self._scaled: dict[float, list[str]] = {}

    @contextmanager
    def frame(self, name: str) -> Iterator[None]:
        """Leaves a frame out, and counts it, if what runs inside raises LeftOutError."""
        self._name = name
        try:
            yield
        except MissingPictureError:
            self.missing.append(name)
        except LeftOutError as error:
            self.leave_out(name, str(error))

    def leave_out(self, name: str, reason: str) -> None:
        """Counts a frame that cannot be used."""
        self._left_out.setdefault(reason, []).append(name)

    def add(self, image: PosedImage) -> None:
        """Adds a row."""
        self.rows.append(image)

    def pose(self, make: Callable[..., Any], *values: Any) -> NDArray[np.float64]:
        """Returns [4, 4] world to camera of the pose that `make(*values)` gives."""
        try:
            return viewmat_from_pose(make(*values), self._name, opengl=self._opengl)
        except UNUSABLE as error:
            raise LeftOutError("whose pose is missing, not finite or not rigid") from error

    def lens(
        self, size: tuple[int, int], make: Callable[..., Sequence[Any]], *values: Any
    ) -> Lens:
        """Returns a PINHOLE of the fx, fy, cx, cy that `make(*values)` gives.

        Intrinsics of images of another size are scaled, and counted.
        """
        try:
            params, factor = fit_intrinsics(make(*values), size, self._name)
            lens = make_lens("PINHOLE", *size, params, self._name)
        except UNUSABLE as error:
            raise LeftOutError(
                f"whose intrinsics are missing or not those of {size[0]}x{size[1]} pixels"
            ) from error
        if factor != 1:
            self._scaled.setdefault(factor, []).append(self._name)
        return lens

    def _describe_left_out(self) -> tuple[str, ...]:
        """Returns one notice for each reason, and for each factor of intrinsics."""
        return tuple(
            f"left out: {format_count(len(names), 'frame')} {reason}, the first is {names[0]}"
            for reason, names in self._left_out.items()) + tuple(
            f"the intrinsics of {format_count(len(names), 'frame')} were scaled by {factor:.4g}: "
            f"they are for images of another size, the first is {names[0]}"
            for factor, names in self._scaled.items())

    def finish(self, *, without_picture: int = 0) -> PosedSet:
        """Returns the frames whose pictures exist, with lenses scaled to the size of the files.

        Sizes are those of the pixels in the file: EXIF orientation is not applied, as COLMAP does
        not. Pictures of one name get their paths as names. `without_picture` counts further poses.
        InputError if no frame has a picture and a pose; FormatError if a picture is listed twice,
        or the sizes of files and lenses differ by more than one common factor.
        """
        rows = self._name_rows()
        there = [row for row in rows if is_file(row.path)]
        missing = tuple(dict.fromkeys(
            [*(row.name for row in rows if not is_file(row.path)), *self.missing]))
        notices = list(self._describe_left_out())
        if not there:
            if missing:
                notices.append(f"it lists {format_count(len(missing), 'picture')}, but none of "
                               f"their files is there, the first is {missing[0]}")
            raise InputError(
                f"{self._folder} has no frame with a pose: "
                f"{'; '.join(notices) or 'it lists none'}.",
                hint="Put the pictures where the data set says. Or give them alone, so that the "
                f"cameras are found from them: {command_line(f'ingest {self._pictures}')}")
        images, factor = _fit_lenses(there)
        if missing:
            notices.append(f"missing: {len(missing)} of the {len(there) + len(missing)} images "
                           f"that it lists, the first is {missing[0]}")
        if factor != 1:
            notices.append(f"its images are {factor:.4g} times as large as its cameras say, so the "
                           "intrinsics were scaled")
        notices += self.notices
        if without_picture:
            notices.append(f"without a picture: {without_picture} of its poses")
        return PosedSet("", images, missing, notices=tuple(notices))

    def finish_tracked(
        self, *, up: tuple[float, float, float] | None = Y_UP, without_picture: int = 0
    ) -> PosedSet:
        """Returns the frames that a phone or headset tracked, in metres.

        With `up` None, up is found from the scene. InputError as `finish`, or if all poses are one
        and the same.
        """
        refuse_one_pose(self.rows, self._folder, self._pictures)
        return replace(self.finish(without_picture=without_picture), metric=True, sequence=True,
                       up=up, find_up=up is None, accuracy="tracked")

    def _name_rows(self) -> list[PosedImage]:
        """Returns the rows, called by their paths where several pictures have one name."""
        counts = Counter(row.name for row in self.rows)
        rows = self.rows
        if len(counts) < len(rows) and all(
                row.path.is_relative_to(self._folder) for row in rows):
            rows = [replace(row, name=row.path.relative_to(self._folder).as_posix())
                    for row in rows]
            counts = Counter(row.name for row in rows)
        if twice := [name for name, count in counts.items() if count > 1]:
            raise FormatError(
                f"{self._folder} lists {len(twice)} images more than once, the first is "
                f"{twice[0]}.", hint="Leave one pose for each image.")
        return rows


def refuse_one_pose(images: Sequence[PosedImage], folder: Path, pictures: str) -> None:
    """Raises InputError for frames that all have one pose: the app did not track the camera.

    `pictures` is what to type instead.
    """
    poses = [image.viewmat for image in images]
    if len(poses) > 1 and np.abs(np.stack(poses) - poses[0]).max() < _MOVED:
        raise InputError(
            f"All {len(poses)} poses of {folder} are the same: the camera was not tracked, as in "
            "recordings of a front camera.", hint="Give the pictures alone, so that the cameras "
            f"are found from them: {command_line(f'ingest {pictures}')}")


def _fit_lenses(rows: Sequence[PosedImage]) -> tuple[tuple[PosedImage, ...], float]:
    """Returns rows with lenses of the size of the files, and how much larger these mostly are."""
    sizes = [image_size(row.path) if row.is_picture else (row.lens.width, row.lens.height)
             for row in rows]
    factor = float(np.median([
        width / row.lens.width for row, (width, _) in zip(rows, sizes, strict=True)]))
    slack = 0 if factor == 1 else 1  # pixels; sizes of reduced images are rounded
    images = []
    for row, (width, height) in zip(rows, sizes, strict=True):
        lens = row.lens
        off = max(abs(width - factor * lens.width), abs(height - factor * lens.height))
        if off > slack:
            raise FormatError(
                f"{row.path} is {width}x{height} pixels, but its camera "
                f"{lens.width}x{lens.height}; most images are {factor:.4g} times as "
                "wide as their cameras, which is not a common factor.",
                hint="Use the images that the poses were made for, all of them or all reduced "
                "by one factor; the size is that of the file, before any EXIF rotation.")
        if (width, height) != (lens.width, lens.height):
            lens = lens.resized(width, height)
        images.append(replace(row, lens=lens, depth=row.depth and row.depth.with_lens(lens)))
    return tuple(images), factor


def read_object(path: Path | None, without: str) -> dict[str, Any]:
    """Returns the JSON object in a frame's file; LeftOutError if it is damaged or `without` it."""
    if path is None:
        raise LeftOutError(without)
    try:
        value: dict[str, Any] = read_json(path, dict, finite=False)
    except FormatError as error:
        raise LeftOutError("whose file cannot be read as JSON") from error
    return value


def read_size(path: Path) -> tuple[int, int]:
    """Returns (width, height) of a frame's picture; LeftOutError if it cannot be read."""
    try:
        return image_size(path)
    except FormatError as error:
        raise LeftOutError("that cannot be read") from error
