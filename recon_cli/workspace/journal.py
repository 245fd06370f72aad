"""Digests of unfinished work, so that a run does not continue from a damaged file.

`.partial/<stage>.digests` lies beside the folder that a stage writes in. Before a file is put in
place there, a line with its size and CRC-32 is added, and one without when it is there. A crash at
any moment leaves each file as one of the last two lines of its name say, or not there yet. CRC-32
takes a third of the time of SHA-256, and damage is not an attack. Jobs that a stage shares out work
in folders below `jobs`, perhaps on other machines, and keep digests of their own there.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from recon_cli.workspace import durable
from recon_cli.workspace.paths import is_plain_file

PARTIAL = ".partial"  # the folder of unfinished work in a workspace
SUFFIX = ".digests"
JOBS = "jobs"  # the folder, in that of a stage, of jobs that it shares out
_CHUNK = 1 << 20  # bytes


@dataclass(frozen=True)
class _State:
    """A file as it may be found; `size` is None where it may be missing."""

    size: int | None
    crc: int = 0
    grows: bool = False  # only the first `size` bytes count


_MISSING = _State(None)


@dataclass
class _History:
    """The last two states of a file; the last may not have been reached where it is pending."""

    last: _State = _MISSING
    before: _State = _MISSING
    pending: bool = False

    def allows_missing(self) -> bool:
        return self.last.size is None or (self.pending and self.before.size is None)


def journal_path(folder: Path) -> Path:
    """Returns where the digests of the files below a stage's folder are kept."""
    return folder.with_name(folder.name + SUFFIX)


def start(folder: Path) -> None:
    """Begins to keep digests of the files below a folder of unfinished work."""
    journal_path(folder).write_bytes(b"")


def expect(path: Path, temporary: Path) -> None:
    """Records that `path` is about to get the content of `temporary`, if digests are kept there."""
    place = _find(path)
    if place:
        size = temporary.stat().st_size
        _append(*place, "file", size, crc32(temporary, size), flush=True)


def confirm(path: Path) -> None:
    """Records that `path` is in place."""
    place = _find(path)
    if place:
        _append(*place, "there")


def expect_removal(path: Path) -> None:
    """Records that `path` is about to be deleted."""
    place = _find(path)
    if place:
        _append(*place, "gone", flush=True)


def expect_growth(path: Path) -> None:
    """Records the content of `path` now; lines appended to it later do not count."""
    place = _find(path)
    if place:
        durable.flush(path)
        size = path.stat().st_size
        _append(*place, "grows", size, crc32(path, size), flush=True)


def find_damage(folder: Path) -> str:
    """Describes the damage of unfinished work; empty if a run can continue it.

    Files without a digest were not finished and are deleted, as are bytes appended to a file since.
    """
    journal = journal_path(folder)
    try:
        histories = _read(journal)
    except (OSError, ValueError):
        return f"{journal.name} is missing or damaged"
    for path in _files_below(folder):
        if path.relative_to(folder).as_posix() not in histories:
            path.unlink()
    for name, history in histories.items():
        path = folder / name
        if not os.path.lexists(path):
            if not history.allows_missing():
                return f"{name} is missing"
        elif not any(_restore(path, state) for state in (history.last, history.before)):
            return f"{name} is damaged"
    return ""


def remove_strange(folder: Path) -> None:
    """Removes links, pipes and the like below a folder of unfinished work: no stage makes any."""
    for path in _files_below(folder):
        if not is_plain_file(path):
            path.unlink()


def make_way(path: Path) -> None:
    """Removes a folder of unfinished work where a file is to be."""
    if path.is_dir() and not path.is_symlink() and PARTIAL in path.parts:
        shutil.rmtree(path)


def crc32(path: Path, size: int | None = None) -> int:
    """Returns the CRC-32 of a file, or of its first `size` bytes."""
    value, left = 0, path.stat().st_size if size is None else size
    with path.open("rb") as file:
        while left > 0 and (data := file.read(min(_CHUNK, left))):
            value, left = zlib.crc32(data, value), left - len(data)
    return value


def _restore(path: Path, state: _State) -> bool:
    """Returns whether a file is in a state; bytes appended since are cut off."""
    if state.size is None or path.is_symlink() or not path.is_file():
        return False
    size = path.stat().st_size
    if (size < state.size or (size > state.size and not state.grows)
            or crc32(path, state.size) != state.crc):
        return False
    if size > state.size:
        os.truncate(path, state.size)
    return True


def _find(path: Path) -> tuple[Path, str] | None:
    """Returns the file of digests that covers `path`, and the name of `path` in it, if any."""
    for folder in path.parents:
        if folder.parent.name == PARTIAL:
            journal, name = journal_path(folder), path.relative_to(folder)
            kept = is_plain_file(journal) and name.parts[0] != JOBS
            return (journal, name.as_posix()) if kept else None
    return None


def _append(journal: Path, name: str, *values: object, flush: bool = False) -> None:
    """Adds a line in one write, so that lines of several threads do not mix."""
    text = json.dumps([name, *values])
    line = f"{zlib.crc32(text.encode()):08x} {text}\n".encode()
    descriptor = os.open(journal, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
    try:
        os.write(descriptor, line)
        if flush:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read(journal: Path) -> dict[str, _History]:
    """Returns the states of each file by name; ValueError for a damaged line.

    A last line without its end was being written.
    """
    if not is_plain_file(journal):
        raise ValueError("it is not a plain file")
    histories: dict[str, _History] = {}
    for line in journal.read_bytes().split(b"\n")[:-1]:
        crc, _, text = line.partition(b" ")
        if int(crc, 16) != zlib.crc32(text):
            raise ValueError("a line was changed")
        name, event, *values = json.loads(text)
        history = histories.setdefault(name, _History())
        if event == "there":
            history.pending = False
            continue
        state = _State(values[0], values[1], event == "grows") if values else _MISSING
        history.before, history.last, history.pending = history.last, state, event == "file"
    return histories


def _files_below(folder: Path) -> Iterator[Path]:
    """Yields all but folders below a folder, without those of jobs; links are not followed."""
    for parent, folders, files in os.walk(folder):
        if Path(parent) == folder and JOBS in folders and not (folder / JOBS).is_symlink():
            folders.remove(JOBS)
        for name in [*files, *(name for name in folders if (Path(parent) / name).is_symlink())]:
            yield Path(parent) / name
