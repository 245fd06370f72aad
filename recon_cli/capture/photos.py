"""A folder of photos: which files are photos, whether they fit together, and their frame names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.capture.images import PHOTO_SUFFIXES, Photo, inspect_photo
from recon_cli.errors import InputError

MIN_FRAMES = 3  # two views leave nothing to check a reconstruction with
SAFE_STEM = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
# Focal lengths that agree this well are one setting of the lens; EXIF rounds to whole mm.
SAME_FOCAL = 0.01


@dataclass(frozen=True)
class Folder:
    """The photos of a folder in the order in which a person counts, and what is broken.

    Attributes:
        photos: readable by their header.
        broken: why each file that is named like a photo, but is none, was refused, by file name.
    """

    photos: tuple[Photo, ...]
    broken: dict[str, str]


def list_photos(folder: Path) -> Folder:
    """Returns the photos in a folder, by content; hidden files and subfolders are left out."""
    photos: list[Photo] = []
    broken: dict[str, str] = {}
    files = (path for path in folder.iterdir() if path.is_file() and path.name[0] != ".")
    for path in sorted(files, key=lambda path: (_counting(path.stem), path.name)):
        try:
            photos.append(inspect_photo(path))
        except InputError as error:
            if path.suffix.lower() in PHOTO_SUFFIXES:
                broken[path.name] = error.message
    return Folder(tuple(photos), broken)


def _counting(stem: str) -> list[tuple[int, str]]:
    """Returns a sort key by which 2 comes before 10."""
    parts = re.split(r"(\d+)", stem)
    return [(int(part) if part.isdecimal() else -1, part) for part in parts]


def check_count(folder: Path, readable: int, broken: dict[str, str]) -> None:
    """Raises InputError when too few photos are readable to reconstruct anything."""
    if readable >= MIN_FRAMES:
        return
    first = next(iter(broken.values()), "")
    raise InputError(
        f"{folder}: {readable} photos, {len(broken)} more that cannot be read, but at least "
        f"{MIN_FRAMES} are needed. {first}".rstrip(),
        hint="Give a video file, or a folder with photos of one room (JPEG, PNG, TIFF, WebP, "
        "camera RAW; HEIC has to be converted first).")


def check_sizes(photos: Sequence[Photo]) -> None:
    """Raises InputError when photos differ in size, for they then differ in camera or zoom."""
    sizes = Counter((photo.width, photo.height) for photo in photos)
    if len(sizes) > 1:
        listed = ", ".join(f"{n} of {w}x{h}" for (w, h), n in sizes.most_common())
        raise InputError(
            f"The photos differ in size: {listed}.",
            hint="Give photos of one size and orientation; move the others to another folder.")


def shared_focal(photos: Sequence[Photo]) -> float | None:
    """Returns the focal length in pixels on which all photos agree, else None."""
    focals = [photo.focal_px for photo in photos]
    known = [focal for focal in focals if focal is not None]
    if len(known) < len(focals) or max(known) > min(known) * (1 + SAME_FOCAL):
        return None
    return known[0]


def frame_names(photos: Sequence[Photo]) -> list[str]:
    """Returns a PNG name for each photo, sorted as the photos are.

    They keep their own names where those are plain, differ (also where case does not count) and
    sort in the order of the photos; else all are numbered, for a mixture would not sort.
    """
    stems = [photo.path.stem for photo in photos]
    plain = all(SAFE_STEM.fullmatch(stem) for stem in stems)
    distinct = len({stem.lower() for stem in stems}) == len(stems)
    names = [f"{stem}.png" for stem in stems]
    if plain and distinct and names == sorted(names):
        return names
    return [f"{index:06d}.png" for index in range(len(photos))]
