"""Masks of photos: from a folder of masks, or from the photo's own transparency.

White counts, black is ignored. Masks lie in masks/ inside the given folder, or inside its subfolder
that holds the photos. The mask of images/a/1.jpg is masks/a/1.jpg.png as COLMAP names it,
masks/a/1.png, or masks/a/1.jpg; any picture's suffix will do. Without subfolders of that name it
may be masks/1.png, if no other image is called so. RealityScan's layers are folders called .mask,
or files like 1.jpg.mask.png beside the image. Masks beside the given folder are not used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.images import PHOTO_SUFFIXES, RAW_SUFFIXES, Photo, read_alpha, read_rgb
from recon_cli.errors import InputError
from recon_cli.io.images import HALF
from recon_cli.workspace import atomic

MASK_FOLDERS = ("masks", "mask", ".mask")
_LAYER = ".mask"  # before the suffix of a mask
_SUFFIXES = PHOTO_SUFFIXES - RAW_SUFFIXES - {".jxl"}
Key = TypeVar("Key")


@dataclass(frozen=True)
class FolderMasks:
    """The masks of a folder of photos."""

    by_photo: dict[str, Path]  # by the photo's file name
    unused: tuple[str, ...]  # file names of masks without a photo
    outside: Path | None = None  # a folder of masks beside the given one


def is_mask_file(path: Path) -> bool:
    """Returns whether a picture beside others is called the mask of one."""
    return path.suffix.lower() in _SUFFIXES and path.stem.lower().endswith(_LAYER)


def mask_folders(folder: Path) -> list[Path]:
    """Returns the folders of masks in a folder, and itself if masks lie beside its images."""
    with suppress(OSError):
        entries = sorted(folder.iterdir())
        return [*[folder] * any(map(is_mask_file, entries)), *(
            path for path in entries if path.name.lower() in MASK_FOLDERS and path.is_dir())]
    return []


def match_masks(
    folder: Path, images: Mapping[Key, PurePosixPath]
) -> tuple[dict[Key, Path], list[str]]:
    """Returns the masks of images, given by their relative paths, and the names of other masks."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))
             if path.suffix.lower() in _SUFFIXES and path.name[0] != "." and path.is_file()}
    if folder.name.lower() not in MASK_FOLDERS and any(map(is_mask_file, files.values())):
        files = {name: path for name, path in files.items() if is_mask_file(path)}
    plain: dict[str, Path] = {}  # without the last suffix
    for name, path in reversed(files.items()):
        plain[str(PurePosixPath(name).with_suffix("")).lower().removesuffix(_LAYER)] = path
    alone = Counter(str(image.with_suffix("").name).lower() for image in images.values())
    masks: dict[Key, Path] = {}
    for key, image in images.items():
        stem = str(image.with_suffix(""))
        names = [str(image), stem]
        if len(image.parts) > 1 and alone[PurePosixPath(stem).name.lower()] == 1:
            names += [image.name, PurePosixPath(stem).name]
        mask = next((plain[name.lower()] for name in names if name.lower() in plain), None)
        if mask is not None:
            masks[key] = mask
    used = set(masks.values())
    return masks, [name for name, path in files.items() if path not in used]


def find_masks(given: Path, home: Path, photos: Sequence[Photo]) -> FolderMasks:
    """Returns the masks of the photos below `home`, which is the `given` folder or one in it.

    Those of photos in subfolders lie in the same subfolders of the folder of masks, or in one
    beside them.
    """
    deeper = {photo.path.parent for photo in photos} - {home, given}
    inner = sorted({folder for place in (home, given) for folder in mask_folders(place)})
    folders = [*inner, *(folder for place in sorted(deeper) for folder in mask_folders(place))]
    if not folders:
        beside = mask_folders(given.resolve().parent)
        return FolderMasks({}, (), beside[0] if beside else None)
    by_photo: dict[str, Path] = {}
    unused: list[str] = []
    for folder in dict.fromkeys(folders):
        names = {
            photo.name: PurePosixPath(photo.name) if folder in inner
            else PurePosixPath(photo.path.name) for photo in photos
            if folder in inner or photo.path.parent in (folder, folder.parent)}
        found, left = match_masks(folder, names)
        by_photo = {**found, **by_photo}
        unused += left
    return FolderMasks(by_photo, tuple(unused))


def read_mask(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Returns a mask for width x height pixels, [H, W], 255 where they count, else 0.

    Its EXIF orientation is applied; a mask of the same shape but another size is resampled.
    InputError if it cannot be read, has another shape, or ignores every pixel.
    """
    try:
        gray = np.asarray(read_rgb(path).max(axis=2), np.uint8)  # its brightest channel
    except InputError as error:
        raise InputError(
            f"The mask {error.message}", hint="Write it again, or remove it.") from error
    small, large = sorted([gray.shape[::-1], (width, height)])
    if abs(large[1] * small[0] / large[0] - small[1]) > 1:  # more than rounding to whole pixels
        raise InputError(
            f"The mask {path.name} has {gray.shape[1]}x{gray.shape[0]} pixels, but {width}x{height}"
            " or the same shape in another size is needed.",
            hint="Make masks from the photos as they are displayed, upright.")
    mask = _resample(gray, width, height)
    if not mask.any():
        raise InputError(
            f"The mask {path.name} ignores every pixel: its brightest value is {gray.max()}, but "
            "255 marks the pixels that count.",
            hint="Write masks with 0 and 255, or remove the photo.")
    return mask


def opaque(
    alpha: NDArray[np.uint8] | None, name: str, width: int, height: int
) -> NDArray[np.uint8] | None:
    """Returns where a picture is at least half opaque, [H, W], 255 or 0; None for everywhere.

    InputError if it is transparent everywhere.
    """
    if alpha is None or alpha.min() >= HALF:
        return None
    if alpha.max() < HALF:
        raise InputError(
            f"{name} is transparent everywhere.", hint="Leave it out, or save it opaque.")
    return _resample(alpha, width, height)


def photo_mask(
    photo: Photo, path: Path | None, width: int, height: int
) -> NDArray[np.uint8] | None:
    """Returns the mask of a photo stored with width x height pixels, [H, W]; None where all counts.

    It combines the mask file `path`, if there is one, with the photo's transparency. InputError if
    the file cannot be used, or nothing is left.
    """
    opacity = opaque(read_alpha(photo), photo.name, width, height)
    mask = None if path is None else read_mask(path, width, height)
    if mask is None:
        mask = opacity
    elif opacity is not None:
        mask = np.minimum(opacity, mask)
    if mask is None or mask.all():
        return None
    if not mask.any():
        raise InputError(
            f"The mask and the transparency of {photo.name} leave no pixel.",
            hint="Leave the photo out, or give a mask that is white where it counts.")
    return mask


def write_mask(path: Path, mask: NDArray[np.uint8]) -> None:
    """Writes a mask [H, W] as 8-bit gray PNG, atomically, and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _, data = cv2.imencode(".png", mask)
    atomic.write_bytes(path, data.tobytes())


def _resample(values: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    nearest = cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.where(nearest >= HALF, 255, 0).astype(np.uint8)
