"""A folder of photos: which files are photos, whether they suffice, and their frame names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.capture.images import PHOTO_SUFFIXES, Photo, inspect_photo
from recon_cli.errors import InputError

MIN_FRAMES = 3  # two views leave nothing to check a reconstruction with
SAFE_STEM = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
NO_PHOTOS = frozenset({"masks"})  # subfolders that hold pictures, but none of the scene


@dataclass(frozen=True)
class Folder:
    """The photos of a folder in the order in which a person counts, and what is broken.

    Attributes:
        photos: readable by their header.
        broken: why each file that is named like a photo, but is none, was refused, by file name.
    """

    photos: tuple[Photo, ...]
    broken: dict[str, str]


def list_photos(paths: Iterable[Path]) -> Folder:
    """Returns the photos among files, by content; hidden files and folders are left out."""
    photos: list[Photo] = []
    broken: dict[str, str] = {}
    files = (path for path in paths if path.is_file() and path.name[0] != ".")
    for path in sorted(files, key=lambda path: (_counting(path.stem), path.name)):
        try:
            photos.append(inspect_photo(path))
        except InputError as error:
            if path.suffix.lower() in PHOTO_SUFFIXES:
                broken[path.name] = error.message
    return Folder(tuple(photos), broken)


def photo_folder(folder: Path) -> Path:
    """Returns where the photos of a folder lie: in itself, in images/, or in its one subfolder.

    Raises:
        InputError: it holds none, but several of its subfolders do.
    """
    if _holds_photos(folder):
        return folder
    inner = [
        path for path in sorted(folder.iterdir())
        if path.is_dir() and path.name[0] != "." and path.name.lower() not in NO_PHOTOS
        and _holds_photos(path)]
    images = [path for path in inner if path.name == "images"]
    if len(inner) > 1 and not images:
        raise InputError(
            f"{folder} holds no photos itself, but {len(inner)} of its folders do: "
            f"{', '.join(path.name for path in inner)}.",
            hint=f"Give one of them, such as {inner[0]}.")
    return (images or inner or [folder])[0]


def _holds_photos(folder: Path) -> bool:
    """Returns whether a folder holds photos, be they broken."""
    files = [path for path in folder.iterdir() if path.is_file() and path.name[0] != "."]
    if any(path.suffix.lower() in PHOTO_SUFFIXES for path in files):
        return True
    return any(_is_photo(path) for path in files)


def _is_photo(path: Path) -> bool:
    try:
        inspect_photo(path)
    except InputError:
        return False
    return True


def _counting(stem: str) -> list[tuple[int, str]]:
    """Returns a sort key by which 2 comes before 10."""
    parts = re.split(r"(\d+)", stem)
    return [(int(part) if part.isdecimal() else -1, part) for part in parts]


def check_count(folder: Path, readable: int, broken: dict[str, str]) -> None:
    """Raises InputError when too few photos can be used to reconstruct anything.

    Args:
        folder: that holds them, for the message.
        readable: how many can be used.
        broken: why each of the others cannot, by file name.
    """
    if readable >= MIN_FRAMES:
        return
    if not broken:
        raise InputError(
            f"{folder} holds {_photos(readable)}, but at least {MIN_FRAMES} are needed.",
            hint="Give a video file, or a folder with photos of one room (JPEG, PNG, TIFF, WebP, "
            "HEIC, camera RAW).")
    raise InputError(
        f"{folder} holds {_photos(readable)} that can be used and {len(broken)} that cannot, but "
        f"at least {MIN_FRAMES} are needed. The first: {next(iter(broken.values()))}",
        hint="Mend what is named, or copy the photos from the camera again.")


def _photos(count: int) -> str:
    return f"{count or 'no'} photo{'s' * (count != 1)}"


def frame_names(photos: Sequence[Photo]) -> list[str]:
    """Returns a PNG name for each photo, sorted as the photos are; see `names_in_order`."""
    return names_in_order([photo.path.stem for photo in photos])


def names_in_order(stems: Sequence[str]) -> list[str]:
    """Returns a PNG name for each stem, such that the names sort as the stems are ordered.

    They keep their own names where those are plain, differ (also where case does not count) and
    sort in this order; else all are numbered, for a mixture would not sort.
    """
    plain = all(SAFE_STEM.fullmatch(stem) for stem in stems)
    distinct = len({stem.lower() for stem in stems}) == len(stems)
    names = [f"{stem}.png" for stem in stems]
    if plain and distinct and names == sorted(names):
        return names
    return [f"{index:06d}.png" for index in range(len(stems))]
