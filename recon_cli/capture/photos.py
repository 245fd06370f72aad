"""A folder of photos: which files are photos, their frame names, and which share intrinsics."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from recon_cli.capture.frame_selection import MIN_FRAMES
from recon_cli.capture.images import PHOTO_SUFFIXES, Photo, inspect_photo
from recon_cli.errors import InputError

SAFE_STEM = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
NO_PHOTOS = frozenset({"masks"})  # subfolders that hold pictures, but none of the scene
# Focal lengths that agree this well are one setting of the lens: EXIF rounds to a tenth of a mm.
SAME_FOCAL = 0.01


@dataclass(frozen=True)
class PhotoFolder:
    """The photos of a folder in natural order (2 before 10), and what is broken."""

    photos: tuple[Photo, ...]
    broken: dict[str, str]  # why a file that is named like a photo cannot be read, by file name


def list_photos(paths: Iterable[Path]) -> PhotoFolder:
    """Returns the photos among files, by content; hidden files and folders are ignored."""
    photos: list[Photo] = []
    broken: dict[str, str] = {}
    files = (path for path in paths if path.is_file() and path.name[0] != ".")
    for path in sorted(files, key=lambda path: (_natural_key(path.stem), path.name)):
        try:
            photos.append(inspect_photo(path))
        except InputError as error:
            if path.suffix.lower() in PHOTO_SUFFIXES:
                broken[path.name] = error.message
    return PhotoFolder(tuple(photos), broken)


def photo_folder(folder: Path) -> Path:
    """Returns the folder that holds the photos: itself, images/ in it, or its only subfolder.

    InputError if it holds none, but several of its subfolders do.
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
            f"{folder} holds no photos itself, but {len(inner)} of its subfolders do: "
            f"{', '.join(path.name for path in inner)}.",
            hint=f"Give one of them, such as {inner[0]}.")
    return (images or inner or [folder])[0]


def _holds_photos(folder: Path) -> bool:
    """Returns whether a folder holds photos, even if they are broken."""
    files = [path for path in folder.iterdir() if path.is_file() and path.name[0] != "."]
    if any(path.suffix.lower() in PHOTO_SUFFIXES for path in files):
        return True
    for path in files:
        with suppress(InputError):
            inspect_photo(path)
            return True
    return False


def _natural_key(stem: str) -> list[tuple[int, str]]:
    """Returns a sort key by which 2 comes before 10."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", stem)]


def check_count(folder: Path, readable: int, broken: dict[str, str]) -> None:
    """Raises InputError for too few readable photos; `broken` says why others are not."""
    if readable >= MIN_FRAMES:
        return
    photos = f"{readable or 'no'} photo{'s' * (readable != 1)}"
    if not broken:
        raise InputError(
            f"{folder} holds {photos}, but at least {MIN_FRAMES} are needed.",
            hint="Give a video file, or a folder with photos of one room (JPEG, PNG, TIFF, WebP, "
            "HEIC, camera RAW).")
    raise InputError(
        f"{folder} holds {photos} that can be used and {len(broken)} that cannot, but "
        f"at least {MIN_FRAMES} are needed. The first: {next(iter(broken.values()))}",
        hint="Fix the files listed above, or copy the photos from the camera again.")


def make_frame_names(stems: Sequence[str]) -> list[str]:
    """Returns PNG names: the stems if plain, unique (ignoring case) and sorted, else numbers."""
    plain = all(SAFE_STEM.fullmatch(stem) for stem in stems)
    distinct = len({stem.lower() for stem in stems}) == len(stems)
    names = [f"{stem}.png" for stem in stems]
    if plain and distinct and names == sorted(names):
        return names
    return [f"{index:06d}.png" for index in range(len(stems))]


@dataclass(frozen=True)
class PhotoGroup:
    """Photos that share intrinsics."""

    name: str  # camera, size and, where two groups share these, focal length; for messages
    photos: tuple[Photo, ...]  # at least one, in their given order

    @property
    def first(self) -> Photo:
        """The photo that gives the size and the focal length of all of them."""
        return self.photos[0]


def group_photos(photos: Sequence[Photo]) -> list[PhotoGroup]:
    """Returns the photos in groups of one size, camera and focal length, by their first photos."""
    groups: list[list[Photo]] = []
    for photo in photos:
        home = next((group for group in groups if _same_camera(group[0], photo)), None)
        if home is None:
            groups.append([photo])
        else:
            home.append(photo)
    names = _name_groups([group[0] for group in groups])
    return [PhotoGroup(name, tuple(group)) for name, group in zip(names, groups, strict=True)]


def odd_photos(groups: Sequence[PhotoGroup]) -> list[Photo]:
    """Returns photos alone in their group, without EXIF and of a unique size: perhaps mistakes."""
    sizes = Counter((group.first.width, group.first.height) for group in groups)
    return [
        group.first for group in groups
        if len(groups) > 1 and len(group.photos) == 1 and not group.first.has_exif
        and sizes[group.first.width, group.first.height] == 1]


def group_notices(groups: Sequence[PhotoGroup]) -> list[str]:
    """Returns notices about the groups; none where there is only one."""
    if len(groups) < 2:
        return []
    listed = ", ".join(f"{len(group.photos)} of {group.name}" for group in groups)
    return [
        f"The photos form {len(groups)} groups with separate intrinsics: {listed}.",
        *(f"{photo.path.name} matches no other photo: {photo.width}x{photo.height}, no EXIF. "
          "Remove it if it does not belong to the scene." for photo in odd_photos(groups))]


def _same_camera(first: Photo, other: Photo) -> bool:
    return (
        (first.width, first.height, first.camera) == (other.width, other.height, other.camera)
        and _same_focal(first.focal_px, other.focal_px)
        and _same_focal(first.focal_mm, other.focal_mm))


def _same_focal(first: float | None, other: float | None) -> bool:
    if first is None or other is None:
        return first is other
    return max(first, other) <= min(first, other) * (1 + SAME_FOCAL)


def _name_groups(firsts: Sequence[Photo]) -> list[str]:
    """Returns a name for each group, with its focal length where that is needed."""
    plain = [f"{photo.camera} {photo.width}x{photo.height}".strip() for photo in firsts]
    twice = {name for name, count in Counter(plain).items() if count > 1}
    counts: Counter[str] = Counter()
    names = []
    for name, photo in zip(plain, firsts, strict=True):
        if name in twice and photo.focal_mm is not None:
            name = f"{name} {photo.focal_mm:g} mm".strip()
        elif name in twice and photo.focal_px is not None:
            name = f"{name} f = {photo.focal_px:.0f} px".strip()
        counts[name] += 1
        names.append(name if counts[name] == 1 else f"{name} ({counts[name]})")
    return names
