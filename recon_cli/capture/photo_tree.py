"""Which pictures below a folder are the photos of a capture, and the other files there.

All pictures below the folder are photos, but for masks, depth and the like, reduced copies, and
the pictures that `capture.known_files` lists. Those left out are named, with the command to type.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from recon_cli.capture.images import PHOTO_SUFFIXES, inspect_photo
from recon_cli.capture.known_files import Found, find_foreign, is_archive, picture_kind
from recon_cli.capture.masks import MASK_FOLDERS, is_mask_file
from recon_cli.errors import InputError, command_line, list_names
from recon_cli.workspace.layout import Workspace

VIDEO_SUFFIXES = frozenset({
    ".360", ".3gp", ".avi", ".gif", ".insv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpg",
    ".mts", ".webm", ".wmv"})
_ARRAYS = frozenset({".exr", ".npy", ".npz", ".pfm"})
_REDUCED = re.compile(r"images_\d+")  # nerfstudio's and COLMAP's copies beside images/
_PICTURE_FOLDERS = frozenset({
    "color", "corrected_images", "frames", "images", "input", "keyframes", "photos", "pictures",
    "rgb", "rgbd"})
_VERSIONS = "other versions of these photos"


@dataclass(frozen=True)
class PhotoTree:
    """The pictures below a folder that may be photos."""

    home: Path  # the folder that holds all photos, directly or deeper: the given one or below it
    files: tuple[Path, ...]  # those that are called or look like pictures, and maybe others
    foreign: tuple[Found, ...]  # what other programs left beside them
    notices: tuple[str, ...]


@dataclass
class _Walk:
    """The photos and other files found below a folder."""

    folders: dict[Path, list[Path]] = field(default_factory=dict)  # with photos, by folder
    aside: dict[Path, tuple[str, int]] = field(default_factory=dict)  # kind and number of pictures


def find_photo_files(folder: Path, out: Path | None = None) -> PhotoTree:
    """Returns the pictures below a folder; `out`, where ingest writes, is left out.

    InputError if it holds none itself, but several of its subfolders do.
    """
    foreign = _find_foreign(folder)
    home = _choose_home(folder, foreign, out)
    walk = _walk(home, foreign, out)
    top = {path.stem for path in walk.folders.get(home, ())}
    for place in [place for place in walk.folders if place != home]:
        same = sum(path.stem in top for path in walk.folders[place])
        if 2 * same > len(walk.folders[place]):  # most are called like those above
            walk.aside[place] = _VERSIONS, len(walk.folders.pop(place))
    _add_beside(walk, folder, home, out)
    files = tuple(path for paths in walk.folders.values() for path in paths)
    notices = (
        *_describe_home(folder, home, walk),
        *_describe_aside(folder, home, walk, [found.row.carries for found in foreign]),
        *(_describe_media(list(dict.fromkeys([folder, home]))) if files else ()),
        *(found.notice(folder) for found in foreign))
    return PhotoTree(home, files, tuple(foreign), notices)


def find_videos(folder: Path, out: Path | None = None) -> list[Path]:
    """Returns the videos below a folder; not hidden ones, nor those of workspaces and `out`."""
    return [*(path for path in _files(folder) if path.suffix.lower() in VIDEO_SUFFIXES),
            *(video for inner in _subfolders(folder, out) if not inner.is_symlink()
              for video in find_videos(inner, out))]


def _add_beside(walk: _Walk, folder: Path, home: Path, out: Path | None) -> None:
    """Adds the folders with pictures beside `home`, up to the one that was given."""
    while home != folder:
        for path in _subfolders(home.parent, out):
            if path != home and (count := _count_pictures(path)):
                walk.aside[path] = picture_kind(path.name) or "pictures", count
        home = home.parent


def _describe_home(folder: Path, home: Path, walk: _Walk) -> Iterator[str]:
    """Yields where the photos lie, unless they are all in the folder that was given."""
    if home != folder:
        yield (f"{folder} holds no photos itself: those in {_relative(home, folder)}/ are used.")
    deeper = [place for place in walk.folders if place != home]
    if deeper:
        count = sum(len(walk.folders[place]) for place in deeper)
        names = list_names([f"{_relative(place, home)}/" for place in sorted(deeper)])
        yield (f"{count} photos in subfolders are used too: {names}. To use only some, give their "
               f"folders, or files such as {shlex.quote(str(home))}/*.jpg.")


def _describe_aside(
    folder: Path, home: Path, walk: _Walk, told: Sequence[str]
) -> Iterator[str]:
    """Yields which folders with pictures are left out, and how to use them.

    `told` are the files of programs that are named anyway.
    """
    for place, (kind, count) in sorted(walk.aside.items()):
        if kind in ("depth maps", "confidence maps") and any("depth" in text for text in told):
            continue
        name = f"{_relative(place, folder)}/"
        if kind == "masks":
            if place.name.lower() not in MASK_FOLDERS:
                yield (f"{name} holds {count} masks, by its name, and is not used: masks are read "
                       f"from {home.parent if home != folder else home}/masks/.")
        elif kind in ("pictures", "photos behind a link", _VERSIONS):
            yield (f"{name} holds {count} {kind} and is not used; "
                   f"{command_line(f'ingest {shlex.quote(str(place))}')} uses it instead.")
        else:
            yield (f"{name} holds {count} {kind}, by its name, and is not used: cameras and "
                   "geometry are found from the photos alone.")


def describe_unused(
    folder: Path, used: Collection[Path], layout: str, words: str
) -> list[str]:
    """Returns the unused files in the folder of a data set: depth, masks, other poses.

    `layout` is the name of its layout, `words` what that is called in a sentence.
    """
    notices = []
    for path in _subfolders(folder, None):
        kind, count = picture_kind(path.name), _count_pictures(path)
        taken = any(one.is_relative_to(path) for one in used)
        if kind and count and not taken and path.name.lower() not in MASK_FOLDERS:
            notices.append(f"{path.name}/ holds {count} {kind}, by its name, and is not used" + (
                f": masks are read from {folder}/masks/." if kind == "masks" else "."))
    notices += [f"{found.place} is {found.row.words} and is not used: the folder is read as "
                f"{words}." for found in find_foreign(folder, known=used)
                if found.row.layout != layout
                and found.row.marks and b'"transform_matrix"' not in found.row.marks]
    return notices


def _describe_media(folders: Sequence[Path]) -> Iterator[str]:
    """Yields which videos and archives lie beside photos."""
    files = [path for folder in folders for path in _files(folder)]
    videos = [path for path in files if path.suffix.lower() in VIDEO_SUFFIXES]
    if videos:
        names = list_names([path.name for path in videos])
        both = shlex.join([str(folders[0]), str(videos[0])])
        yield (f"Not used beside photos are videos: {names}. {command_line(f'ingest {both}')} uses "
               f"{'both' if len(videos) == 1 else 'the first, too'}.")
    arrays = [path.name for path in files if path.suffix.lower() in (".exr", ".pfm")]
    if arrays:
        yield (f"Not used are {len(arrays)} pictures of depth or high range: "
               f"{list_names(arrays)}.")
    archives = [path.name for path in files if is_archive(path)]
    if archives:
        yield (f"Not used are archives: {list_names(archives)}. Unpack them if they hold "
               "photos of the scene.")


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _find_foreign(folder: Path) -> list[Found]:
    """Returns other programs' files in a folder, and above one that is called like photos."""
    resolved = folder.resolve()
    above = resolved.parent
    found = find_foreign(folder)
    if folder.name.lower() in _PICTURE_FOLDERS or resolved.name.lower() in _PICTURE_FOLDERS:
        found += find_foreign(above)
        if above.name.lower() in _PICTURE_FOLDERS:
            found += find_foreign(above.parent)
    unique = {one.row.words: one for one in reversed(found)}
    return list(reversed(unique.values()))


def _choose_home(folder: Path, foreign: Sequence[Found], out: Path | None) -> Path:
    """Returns the folder that holds the photos; itself where none does."""
    for found in foreign:
        if found.folder == folder:
            for pattern in found.row.photos:
                for place in sorted(folder.glob(pattern)):
                    if place.is_dir() and any(_photos_in(place)):
                        return place
    if not all(_is_excluded(path, foreign) for path in _photos_in(folder)):
        return folder
    inner = [path for path in _subfolders(folder, out)
             if not picture_kind(path.name) and _walk(path, foreign, out).folders]
    images = [path for path in inner if path.name.lower() == "images"]
    if len(inner) > 1 and not images:
        command = command_line(f"ingest {shlex.join(map(str, inner))}")
        raise InputError(
            f"{folder} holds no photos itself, but {len(inner)} of its subfolders do: "
            f"{list_names([path.name for path in inner], 8)}.",
            hint=f"Give those that show the scene, one or several: {command}")
    if not inner:
        return folder
    place = (images or inner)[0]
    return place if any(_photos_in(place)) else _choose_home(place, foreign, out)


def _walk(home: Path, foreign: Sequence[Found], out: Path | None) -> _Walk:
    """Returns the folders with photos from `home` on, and those that are left out."""
    walk = _Walk()
    waiting = [home]
    while waiting:
        folder = waiting.pop()
        photos = [path for path in _photos_in(folder) if not _is_excluded(path, foreign)]
        if photos:
            walk.folders[folder] = photos
        for path in _subfolders(folder, out):
            kind = picture_kind(path.name)
            if not kind and _REDUCED.fullmatch(path.name) and (folder / "images").is_dir():
                kind = "small copies"
            if path.is_symlink():  # it may lead round, and is not watched for changes
                kind = kind or "photos behind a link"
            if not kind:
                waiting.append(path)
            elif count := _count_pictures(path):
                walk.aside[path] = kind, count
    return walk


def _is_excluded(path: Path, foreign: Sequence[Found]) -> bool:
    """Returns whether the program that wrote a file does not mean it for a photo."""
    return is_mask_file(path) or any(
        path.match(pattern) for found in foreign for pattern in found.row.not_photos)


def _subfolders(folder: Path, out: Path | None) -> list[Path]:
    """Returns the folders in a folder, and links to some, without hidden ones and workspaces."""
    return [path for path in _entries(folder)
            if path.is_dir() and not Workspace(path).holds_results
            and not (out is not None and out.resolve().is_relative_to(path.resolve()))]


def _files(folder: Path) -> list[Path]:
    return [path for path in _entries(folder) if path.is_file()]


def _entries(folder: Path) -> list[Path]:
    """Returns the entries of a folder, without hidden files; none where it may not be read."""
    with suppress(PermissionError):
        return sorted(path for path in folder.iterdir() if path.name[0] != ".")
    return []


def _photos_in(folder: Path) -> Iterator[Path]:
    """Yields the photos in a folder, even if they are broken."""
    return (path for path in _files(folder) if _is_photo(path))


def _count_pictures(folder: Path) -> int:
    """Returns how many pictures a folder holds, or arrays that may be depth."""
    return sum(path.suffix.lower() in _ARRAYS or _is_photo(path) for path in _files(folder))


def _is_photo(path: Path) -> bool:
    if path.suffix.lower() in PHOTO_SUFFIXES:
        return True
    if path.suffix and path.suffix.lower() in VIDEO_SUFFIXES:
        return False
    with suppress(InputError):
        inspect_photo(path)
        return True
    return False
