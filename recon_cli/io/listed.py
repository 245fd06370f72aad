"""From the images that a data set lists to those that are there, each with a lens of its size."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.errors import FormatError, InputError
from recon_cli.io.depth_points import DepthFile
from recon_cli.io.posed import PosedImage
from recon_cli.scene.camera import Lens

SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")
_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "PPM")


@dataclass(frozen=True, eq=False)
class Listed:
    """An image as a data set lists it; the fields are those of `PosedImage`.

    Attributes:
        name: unique within the set.
        path: where its file should be.
        lens: intrinsics as the data set gives them, whatever the size of the file.
        viewmat: [4, 4] float64 world to camera, OpenCV axes.
        held_out: the data set itself keeps it for the score.
        depth: its depth, None where there is none.
        mask: file of a mask, None where there is none.
    """

    name: str
    path: Path
    lens: Lens
    viewmat: NDArray[np.float64]
    held_out: bool = False
    depth: DepthFile | None = None
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class Found:
    """What is left of a list; the fields are those of `PosedSet`."""

    lenses: tuple[Lens, ...]
    images: tuple[PosedImage, ...]
    missing: tuple[str, ...]
    notices: tuple[str, ...]


def find_images(
    listed: Sequence[Listed], where: Path, *, gone: Sequence[str] = ()
) -> Found:
    """Returns the images that are there, with lenses scaled to the size of the files.

    Sizes are those of the pixels in the file: EXIF orientation is not applied, as COLMAP does not.

    Args:
        listed: what the data set lists, in its order.
        where: its folder, for messages.
        gone: names of images that it lists besides, known to be missing.

    Raises:
        FormatError: two images have one name, or one is of another size than its lens without all
            others being so by the same factor.
        InputError: no image is there.
    """
    names = [*(item.name for item in listed), *gone]
    _check_names(names, where)
    there = [item for item in listed if is_file(item.path)]
    if not there:
        first = f" The first is {names[0]}." if names else ""
        raise InputError(
            f"{where} lists {len(names)} images, but none of their files is there.{first}",
            hint="Put the images where the data set says, or give the folder that holds both.")
    missing = (*(item.name for item in listed if not is_file(item.path)), *gone)
    sizes = [image_size(item.path) for item in there]
    factor = _check_sizes(there, sizes)
    lenses: dict[Lens, int] = {}
    images = []
    for item, size in zip(there, sizes, strict=True):
        lens = item.lens if size == _size(item.lens) else item.lens.resized(*size)
        depth = None if item.depth is None else replace(item.depth, lens=lens)
        images.append(PosedImage(
            item.name, item.path, lenses.setdefault(lens, len(lenses)), item.viewmat,
            item.held_out, depth, item.mask))
    return Found(tuple(lenses), tuple(images), missing, _notices(missing, len(names), factor))


def _notices(missing: tuple[str, ...], listed: int, factor: float) -> tuple[str, ...]:
    said = []
    if missing:
        said.append(f"{len(missing)} of the {listed} images that it lists are missing, "
                    f"the first is {missing[0]}")
    if factor != 1:
        said.append(f"its images are {factor:.4g} times as large as its cameras say, so the "
                    "intrinsics were scaled")
    return tuple(said)


def _check_names(names: Sequence[str], where: Path) -> None:
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise FormatError(
            f"{where} lists {len(twice)} images more than once, the first is {twice[0]}.",
            hint="Leave one pose for each image.")


def _check_sizes(there: Sequence[Listed], sizes: Sequence[tuple[int, int]]) -> float:
    """Returns by which factor the files are larger than their lenses."""
    factor = float(np.median([
        width / item.lens.width for item, (width, _) in zip(there, sizes, strict=True)]))
    slack = 0 if factor == 1 else 1  # pixels; whoever reduced the images had to round
    for item, (width, height) in zip(there, sizes, strict=True):
        off = max(abs(width - factor * item.lens.width), abs(height - factor * item.lens.height))
        if off > slack:
            raise FormatError(
                f"{item.path} is {width}x{height} pixels, but its camera "
                f"{item.lens.width}x{item.lens.height}; most images are {factor:.4g} times as "
                "wide as their cameras, which is no common factor.",
                hint="Take the images that the poses were made for, all of them or all reduced "
                "by one factor; pixels count as they lie in the file, before any EXIF turn.")
    return factor


def _size(lens: Lens) -> tuple[int, int]:
    return lens.width, lens.height


def image_size(path: Path) -> tuple[int, int]:
    """Returns (width, height) of an image from its header.

    Raises:
        FormatError: the file is no image.
    """
    try:
        with warnings.catch_warnings():
            # Pillow warns from 89 megapixels and refuses from twice that.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as image:
                return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FormatError(
            f"{path} is no image that can be read.", hint="Copy the image again.") from error


def is_file(path: Path) -> bool:
    """Returns whether a path from a file's text is a file; one too long for a name is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def inside(folder: Path, name: object, where: str) -> Path:
    """Returns folder/name for a relative name that stays in the folder.

    A data set may come from anywhere; it has no business to name files elsewhere on the disk, not
    even images. Links below the folder were laid by its owner and are followed.

    Args:
        folder: the folder of the data set.
        name: a path as the data set writes it, with either kind of slash.
        where: what a message calls the entry.

    Raises:
        FormatError: the name is no text, absolute, or leads out of the folder.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise FormatError(f"{where} has no file name.")
    path = PurePosixPath(name if is_file(folder / name) else name.replace("\\", "/"))
    depth = 0
    for part in path.parts:
        depth += -1 if part == ".." else 1
        if depth < 0:
            break
    drive = len(path.parts[0]) == 2 and path.parts[0][1] == ":" if path.parts else False
    if path.is_absolute() or drive or depth < 0:
        raise FormatError(
            f"{where} names {name}, which lies outside {folder}.",
            hint="Put the files below that folder and name them relative to it.")
    return folder / path
