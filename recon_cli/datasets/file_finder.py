"""Finds the pictures that a list names where they have moved since it was written.

Lists name files by paths of another machine, with another suffix (.png for .jpg) or in another
case. Nothing outside the folder is ever opened.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath

from recon_cli.capture.known_files import picture_kind
from recon_cli.datasets.frame_table import LeftOutError, MissingPictureError
from recon_cli.datasets.posed import SUFFIXES, is_file, resolve_inside
from recon_cli.errors import FormatError

_PICTURES = frozenset(suffix.lower() for suffix in SUFFIXES)


class FileFinder:
    """Finds the files that a list names, also by paths of the machine that it was written on.

    Such a file is the one below the folder that has the same name, else the same in another case,
    else, of pictures, the same but for the suffix; that is not listed itself and, among several,
    shares the most folders at the end of its path.
    """

    def __init__(self, folder: Path, names: Sequence[object]) -> None:
        self._folder = folder
        self._names = names
        self._moved: dict[str, Path] = {}  # the names that are not a path in the folder

    def find(self, name: object, where: str) -> Path:
        """Returns the path of a file, which exists unless none has its name.

        FormatError if `name` is not a string, or leads out of the folder and no file has its name.
        """
        try:
            path = with_suffix(resolve_inside(self._folder, name, where))
        except FormatError:
            match = self._match(name)
            if match is None:
                raise
            return match
        return path if is_file(path) else self._match(name) or path

    def find_photo(self, name: str) -> Path:
        """Returns the picture of a name; LeftOutError where there is none or not one alone."""
        fitting = self._photos[name]
        if not fitting:
            raise MissingPictureError
        if len(fitting) > 1 or self._takers[fitting[0]] > 1:
            raise LeftOutError(
                "whose photos nothing tells apart: several have one name, and no folder of theirs "
                "is called as in the list")
        return fitting[0]

    @cached_property
    def _photos(self) -> dict[str, list[Path]]:
        """The files that fit each name."""
        photos = {}
        for name in map(str, self._names):
            paths = self._fitting(name)
            with suppress(FormatError):
                path = with_suffix(resolve_inside(self._folder, name, ""))
                paths = [path] if is_file(path) else paths
            photos[name] = [path for path in paths if path.suffix.lower() in _PICTURES]
        return photos

    @cached_property
    def _takers(self) -> Counter[Path]:
        """How many names a file fits."""
        return Counter(
            fitting[0] for name in self._names
            if len(fitting := self._photos[str(name)]) == 1)

    def find_all(self, where: str) -> dict[str, Path]:
        """Returns the files of the names in the list that have one, each of one name alone."""
        files = {}
        for name in self._names:
            with suppress(FormatError):
                path = self.find(name, where)
                if is_file(path):
                    files[str(name)] = path
        twice = {path for path, count in Counter(files.values()).items() if count > 1}
        self._moved = {name: path for name, path in self._moved.items() if path not in twice}
        return {name: path for name, path in files.items() if path not in twice}

    def notices(self) -> list[str]:
        """Returns a notice where files were found by their names alone."""
        if not self._moved:
            return []
        name, path = next(iter(self._moved.items()))
        return [f"{len(self._moved)} of its paths do not exist here, the first is {name}: the "
                "files of the same names in the folder are used, such as "
                f"{path.relative_to(self._folder).as_posix()}"]

    @cached_property
    def _files(self) -> dict[str, list[tuple[str, ...]]]:
        """The files that the list does not name, as parts of paths, by all they may be called."""
        named = set()
        for name in self._names:
            with suppress(FormatError):
                named.add(with_suffix(resolve_inside(self._folder, name, "")))
        files: dict[str, list[tuple[str, ...]]] = {}
        for path in sorted(self._folder.rglob("*")):
            if path not in named and path.is_file():
                parts = path.relative_to(self._folder).parts
                keys = [parts[-1], _folded(parts[-1])]
                if path.suffix.lower() in _PICTURES:
                    keys.append(_stem(parts[-1]))
                for key in dict.fromkeys(keys):
                    files.setdefault(key, []).append(parts)
        return files

    def _match(self, name: object) -> Path | None:
        """Returns the one file that fits a name best, None if there is none or a tie."""
        fitting = self._fitting(name)
        if len(fitting) != 1:
            return None
        self._moved[str(name)] = fitting[0]
        return fitting[0]

    def _fitting(self, name: object) -> list[Path]:
        """Returns the files that fit a name best, several in a tie."""
        # Windows' rules split at both kinds of slashes.
        wanted = PureWindowsPath(name).parts if isinstance(name, str) else ()
        if not wanted:
            return []
        kind = _kind(wanted)
        last = wanted[-1]
        for keys in ([last, *(last + suffix for suffix in SUFFIXES)], [_folded(last)],
                     [_stem(last), _stem(f"{last}.")]):
            candidates = [parts for key in keys for parts in self._files.get(key, ())
                          if _kind(parts) == kind]
            if candidates:
                shared = [_shared_folders(parts[:-1], wanted[:-1]) for parts in candidates]
                return [self._folder.joinpath(*parts) for parts, count in zip(
                    candidates, shared, strict=True) if count == max(shared)]
        return []


def with_suffix(path: Path) -> Path:
    """Returns the file that a path without its suffix stands for, as NeRF's own scenes write it."""
    if is_file(path):
        return path
    named = (path.with_name(path.name + suffix) for suffix in SUFFIXES if path.name)
    return next((file for file in named if is_file(file)), path)


def _folded(name: str) -> str:
    """Returns the key of a name in any case; no file is called so."""
    return f"/{name.casefold()}"


def _stem(name: str) -> str:
    """Returns the key of a name with any suffix; no file is called so."""
    return f"//{PurePosixPath(name).stem.casefold()}"


def _kind(parts: Sequence[str]) -> str:
    """Returns the content of pictures by the folders of a path: a mask is not a photo."""
    return next((kind for part in parts[:-1] if (kind := picture_kind(part))), "")


def _shared_folders(folders: Sequence[str], others: Sequence[str]) -> int:
    """Returns how many folders two paths share at their ends, in any case."""
    pairs = zip(reversed(folders), reversed(others), strict=False)
    return len(list(takewhile(lambda pair: pair[0].casefold() == pair[1].casefold(), pairs)))
