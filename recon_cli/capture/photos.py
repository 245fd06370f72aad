"""A folder of photos: which files are photos, their frame names, and which share intrinsics."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from recon_cli.capture.depth_pictures import look_like_depth
from recon_cli.capture.images import PHOTO_SUFFIXES, Photo, inspect_photo
from recon_cli.capture.known_files import picture_kind
from recon_cli.capture.limits import SAMPLED_PICTURES
from recon_cli.capture.panoramas import choose_projection
from recon_cli.capture.photo_tree import find_videos
from recon_cli.errors import (
    MOST_NAMED,
    InputError,
    command_line,
    format_count,
    list_names,
    name_command,
)
from recon_cli.io.views import evenly_spread
from recon_cli.workspace.records import MIN_FRAMES

SAFE_STEM = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
_COLOURED = frozenset({"RGB", "RGBA", "RGBX", "P", "PA", "CMYK", "YCbCr", "LAB", "HSV"})
_DEPTH = "depth maps"
_NEVER = (_DEPTH, "confidence maps")  # of one channel and with such a name, they are never photos
# Focal lengths that agree this well are one setting of the lens: EXIF rounds to a tenth of a mm.
SAME_FOCAL = 0.01


@dataclass(frozen=True)
class PhotoFolder:
    """The photos of a folder in natural order (2 before 10), and the broken files."""

    photos: tuple[Photo, ...]
    broken: dict[str, str]  # why a file that is named like a photo cannot be read, by its name
    panoramas: bool = False  # the photos are equirectangular


def list_photos(paths: Iterable[Path], home: Path | None = None) -> PhotoFolder:
    """Returns the photos among files, by content; hidden files and folders are ignored.

    They are called by their paths below `home`, else by their names.
    """
    photos: list[Photo] = []
    broken: dict[str, str] = {}
    labels = {path: path.name if home is None else path.relative_to(home).as_posix()
              for path in paths if path.is_file() and path.name[0] != "."}
    for path, label in sorted(labels.items(), key=lambda item: _order(item[1])):
        try:
            photos.append(inspect_photo(path, label))
        except InputError as error:
            if path.suffix.lower() in PHOTO_SUFFIXES:
                broken[label] = f"{error.message} {error.hint}".rstrip()
    return PhotoFolder(tuple(photos), broken)


def _order(label: str) -> tuple[list[list[tuple[int, str]]], list[tuple[int, str]], str]:
    """Returns the sort key of a path: folders as a person counts, then names."""
    path = PurePosixPath(label)
    return [_natural_key(part) for part in path.parts[:-1]], _natural_key(path.stem), path.name


def choose_pictures(
    folder: Path, found: PhotoFolder, camera: str
) -> tuple[PhotoFolder, list[str]]:
    """Returns the photos of one projection, without depth maps, masks and labels, and notices.

    Depth maps have one channel of 16 bits, where the others have colours or where they are as dark
    or smooth as no photo is. `camera` is that of IngestConfig. InputError where nothing but depth
    maps, or too little of a projection, is left.
    """
    rest, notices = _drop_depth_and_masks(folder, found.photos)
    chosen = choose_projection(folder.name, rest, camera)
    notices += chosen.notices
    notices += [
        f"{photo.name} holds {photo.pictures} pictures, of which only the first is used. "
        f"{unfold_advice(photo)}" for photo in rest if photo.pictures > 1][:MOST_NAMED]
    return PhotoFolder(chosen.photos, found.broken, chosen.panoramas), notices


def _drop_depth_and_masks(
    folder: Path, photos: Sequence[Photo]
) -> tuple[list[Photo], list[str]]:
    """Returns the photos without pictures of one channel that belong to others, and notices."""
    kinds = {photo: _other_kind(photo) for photo in photos}
    coloured = sum(photo.mode in _COLOURED for photo in photos)
    depth_alone = bool(photos) and set(kinds.values()) == {_DEPTH}
    deep = [photo for photo in photos if kinds[photo] == _DEPTH]
    shows_depth = look_like_depth([photo.path for photo in evenly_spread(deep, SAMPLED_PICTURES)])
    if depth_alone and (shows_depth or picture_kind(folder.resolve().name) == _DEPTH):
        raise InputError(
            f"{folder} holds {len(photos)} depth maps (one channel of 16 bits), not photos.",
            hint="Give the folder of the photos that belong to them, or that of both: recon "
            f"ingest {shlex.quote(str(folder.absolute().parent))}")
    dropped: set[str] = set()
    notices = []
    for kind in sorted(set(kinds.values()) - {""}):
        names = [photo.name for photo in photos if kinds[photo] == kind]
        if coloured < max(MIN_FRAMES, len(names) / 2):  # gray photos, and a few others
            names = [photo.name for photo in photos if kinds[photo] == kind and kind in _NEVER
                     and (picture_kind(photo.path.stem) == kind
                          or (kind == _DEPTH and shows_depth))]
        if not names:
            continue
        dropped.update(names)
        notices.append(
            f"{len(names)} pictures are {kind} and not photos, by their channels and names; they "
            f"are not used: {list_names(names)}."
            + " Masks are read from masks/, called like their photos." * (kind == "masks"))
    return [photo for photo in photos if photo.name not in dropped], notices


def _other_kind(photo: Photo) -> str:
    """Returns the content of a picture of one channel (a mask, depth), "" for an ordinary photo."""
    if photo.mode in _COLOURED:
        return ""
    if photo.mode[0] in "IF":
        return _DEPTH
    return picture_kind(photo.path.stem)


def unfold_advice(photo: Photo) -> str:
    """Returns the command that turns an animation into the pictures that it holds."""
    program = "ffmpeg -i {file} {target}" if photo.path.suffix.lower() in (".png", ".apng") else (
        "magick {file} -coalesce {target}")
    folder = shlex.quote(str(photo.path.with_suffix("")) + "_pictures")
    command = program.format(file=shlex.quote(str(photo.path)), target=f"{folder}/%04d.png")
    return f"To use all: mkdir -p {folder} && {command} && {command_line(f'ingest {folder}')}"


def _natural_key(stem: str) -> list[tuple[int, str]]:
    """Returns a sort key by which 2 comes before 10."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", stem)]


def check_count(folder: Path, photos: Sequence[Photo], broken: dict[str, str]) -> None:
    """Raises InputError for too few readable photos; `broken` says why others are not."""
    readable = len(photos)
    if readable >= MIN_FRAMES:
        return
    count = f"{readable or 'no'} photo{'s' * (readable != 1)}"
    if not broken:
        film = next((photo for photo in photos if photo.pictures >= MIN_FRAMES), None)
        if film is not None:
            raise InputError(
                f"{film.path} is an animation, or a burst, of {film.pictures} frames in one file, "
                "of which photos use the first.", hint=unfold_advice(film))
        raise InputError(
            f"{folder} holds {count}, but at least {MIN_FRAMES} are needed.",
            hint=_count_hint(folder))
    raise InputError(
        f"{folder} holds {count} that can be used and {len(broken)} that cannot, but "
        f"at least {MIN_FRAMES} are needed. The first: {next(iter(broken.values()))}",
        hint="Mend, convert or replace the files listed above.")


def _count_hint(folder: Path) -> str:
    """Returns the input to give instead of a folder with too few photos: a video in it, if any."""
    videos = find_videos(folder) if folder.is_dir() else []
    if videos:
        named = shlex.quote(str(videos[0]))
        return (f"It holds {format_count(len(videos), 'video')}: "
                f"{list_names([path.name for path in videos])}. Type "
                f"{name_command(f'ingest {named}')}, or give several that show one room.")
    return ("Give a video file, or a folder with photos of one room (JPEG, PNG, TIFF, WebP, HEIC, "
            "camera RAW).")


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
        *(f"{photo.name} matches no other photo: {photo.width}x{photo.height}, no EXIF. "
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
