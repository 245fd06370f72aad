"""Captures in one packed file: .r3d of Record3D, which is a zip, unpacked for the time of reading.

What an archive says of itself is not believed: names that lead out, links, sizes that the bytes do
not have, and far more bytes than the file could hold are refused, and nothing is kept of them.
"""

from __future__ import annotations

import re
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from recon_cli.errors import FormatError
from recon_cli.workspace import layout
from recon_cli.workspace.paths import leads_out

_ENTRY = re.compile(r"(?:[^/\\]+/)?(?:metadata|rgbd/[^/\\]+\.(?:jpg|jpeg|depth|conf))")
_HINT = "Copy the recording from the phone again."
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_MOST_ENTRIES = 500_000  # an hour of three files a frame at 45 frames a second
_MOST_ENTRY = 1 << 28  # bytes; metadata of an hour take 100 MB
# Pictures and LZFSE do not shrink any more; metadata, text of numbers, shrink to a third.
_MOST_RATIO = 20
_SPARE = 1 << 28  # bytes that stay free on the disk
_STEP = 1 << 20


def is_packed(path: Path) -> bool:
    """Returns whether a file is a recording of Record3D, by its content, or by its name."""
    if not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return path.suffix.lower() == ".r3d"  # damaged: the reader says so
    inner = {name.rpartition("/")[2] for name in names if name.count("/") < 2}
    return path.suffix.lower() == ".r3d" or (
        "metadata" in inner and any("rgbd/" in name for name in names))


@contextmanager
def unpacked(path: Path, out: Path) -> Iterator[Path]:
    """Yields a folder below `out` with what a recording holds; it is deleted afterwards.

    FormatError if the file is damaged, or holds what no recording does.
    """
    folder = out / "unpacked"
    layout.remove(folder)
    folder.mkdir(parents=True)
    try:
        _unpack(path, folder)
        yield next((one.parent for one in sorted(folder.rglob("metadata"))), folder)
    finally:
        layout.remove(folder)


def _unpack(path: Path, folder: Path) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            listed = archive.infolist()
            if out := next((entry for entry in listed if leads_out(entry.filename)), None):
                raise FormatError(
                    f"{path} holds {out.filename!r:.80}, which leads out of its folder.",
                    hint=_HINT)
            entries = [entry for entry in listed if _ENTRY.fullmatch(entry.filename)]
            _check(path, entries, folder)
            for entry in entries:
                _extract(archive, entry, folder / entry.filename, path)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError,
            OSError, ValueError) as error:
        raise FormatError(
            f"{path} is not a recording of Record3D, or damaged: {error}.", hint=_HINT) from error


def _check(path: Path, entries: list[zipfile.ZipInfo], folder: Path) -> None:
    """Raises FormatError for an archive without a recording, or one that is a bomb."""
    names = [entry.filename for entry in entries]
    if not any(name.endswith("metadata") for name in names):
        raise FormatError(f"{path} holds no `metadata` of Record3D.", hint=_HINT)
    if len(set(names)) < len(names):
        raise FormatError(f"{path} holds a file twice.", hint=_HINT)
    total, packed = sum(entry.file_size for entry in entries), path.stat().st_size
    largest = max((entry.file_size for entry in entries), default=0)
    if len(entries) > _MOST_ENTRIES or largest > _MOST_ENTRY or total > _MOST_RATIO * packed + (
            1 << 20):
        raise FormatError(
            f"{path} of {packed / 1e6:,.0f} MB says that it holds {len(entries):,} files of "
            f"{total / 1e6:,.0f} MB in all, which no recording does.", hint=_HINT)
    free = shutil.disk_usage(folder).free
    if total + _SPARE > free:
        raise FormatError(
            f"{path} needs {total / 1e6:,.0f} MB to unpack, but {free / 1e6:,.0f} MB are free.",
            hint="Free some space, or put the workspace on another disk with -w.")


def _extract(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, path: Path
) -> None:
    """Writes one entry; no more bytes than it says."""
    if entry.compress_type not in _METHODS or entry.flag_bits & 1:
        raise FormatError(f"{path} holds {entry.filename}, which is encrypted or packed in a way "
                          "that Record3D does not use.", hint=_HINT)
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with archive.open(entry) as source, target.open("wb") as file:
        while data := source.read(_STEP):
            written += len(data)
            if written > entry.file_size:
                raise FormatError(f"{path}: {entry.filename} holds more than it says.", hint=_HINT)
            file.write(data)
