"""Which files of a folder are the masks of which images, by their names.

The mask of images/a/1.jpg is masks/a/1.jpg.png as COLMAP names it, masks/a/1.png, or masks/a/1.jpg;
any picture's suffix will do. Without subfolders of that name it may be masks/1.png, if no other
image is called so. RealityScan's layers are folders called .mask, or files like 1.jpg.mask.png
beside the image.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TypeVar

FOLDERS = ("masks", "mask", ".mask")
_LAYER = ".mask"  # before the suffix of a mask
SUFFIXES = frozenset({
    ".avif", ".bmp", ".heic", ".heif", ".hif", ".jp2", ".jpe", ".jpeg", ".jpg", ".pgm", ".png",
    ".ppm", ".tif", ".tiff", ".webp"})
Key = TypeVar("Key")


def is_mask_file(path: Path) -> bool:
    """Returns whether a picture beside others is called the mask of one."""
    return path.suffix.lower() in SUFFIXES and path.stem.lower().endswith(_LAYER)


def mask_folders(folder: Path) -> list[Path]:
    """Returns the folders of masks in a folder, and itself if masks lie beside its images."""
    with suppress(OSError):
        entries = sorted(folder.iterdir())
        return [*[folder] * any(map(is_mask_file, entries)), *(
            path for path in entries if path.name.lower() in FOLDERS and path.is_dir())]
    return []


def match_masks(
    folder: Path, images: Mapping[Key, PurePosixPath]
) -> tuple[dict[Key, Path], list[str]]:
    """Returns the masks of images, given by their relative paths, and the names of other masks."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))
             if path.suffix.lower() in SUFFIXES and path.name[0] != "." and path.is_file()}
    if folder.name.lower() not in FOLDERS and any(map(is_mask_file, files.values())):
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
