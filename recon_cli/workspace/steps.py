"""Unfinished work: a folder of named steps, each with a key, a result and digests of its files.

A log of JSON lines is the only record. A line names a step that is finished, the digest of what it
depends on, what it found, and size and CRC-32 of the files that it left. Lines are only added, each
with a CRC-32 of its own; a last one without its end was being written.

Each file that a stage puts in place (`atomic`) is a step, too, in `.partial/<stage>.steps` beside
its folder: a line before that, and one after. A crash at any moment leaves it as one of the last
two lines of its name say, or not there yet. CRC-32 takes a third of the time of SHA-256, and damage
is not an attack. Jobs that a stage shares out work in folders below `jobs`, perhaps on other
machines, and keep steps of their own there.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from recon_cli.errors import ManifestError
from recon_cli.workspace import durable
from recon_cli.workspace.json_record import JsonRecord, sha256_json
from recon_cli.workspace.paths import is_plain_file

PARTIAL = ".partial"  # the folder of unfinished work in a workspace
SUFFIX = ".steps"  # of the log beside the folder of a stage
LOG = "steps.jsonl"  # in a folder
JOBS = "jobs"  # the folder, in that of a stage, of jobs that it shares out
_CHUNK = 1 << 20  # bytes
_CRC = ', "crc": '  # ends a line, with the CRC-32 of what comes before

Record = TypeVar("Record", bound=JsonRecord)


@dataclass(frozen=True)
class _Entry:
    """What a step left; `files` is None where it was forgotten, or its file was deleted."""

    files: Mapping[str, list[int]] | None  # size and CRC-32 by name
    key: str = ""
    result: Any = None
    grows: bool = False  # only the first bytes of its files count


_NOTHING = _Entry(None)


@dataclass
class _History:
    """The states in which the files of a step may be found, the last one first."""

    states: list[_Entry] = field(default_factory=lambda: [_NOTHING])
    pending: bool = False  # the last state may not have been reached

    @property
    def last(self) -> _Entry:
        return self.states[0]

    def allows_missing(self) -> bool:
        """Returns whether none of the files needs to be there."""
        return not self.last.files or (self.pending and self.states[-1].files is None)


class StepFolder:
    """The steps of the work in a folder that were finished with one key; those of others are not.

    The log is read anew for each question.
    """

    def __init__(self, folder: Path, log: Path | None = None, *, key: str = "") -> None:
        self._folder, self._log, self._key = folder, log or folder / LOG, key

    def find(self, step: str, kind: type[Record]) -> Record | None:
        """Returns the result of a finished step, else None, as for another version's."""
        result = self.result(step)
        try:
            return None if result is None else kind.from_json(result)
        except ManifestError:
            return None

    def result(self, step: str) -> Any:
        """Returns the result of a finished step as JSON, else None."""
        entry = self._finished().get(step)
        return entry.result if entry and self._has_sizes(entry) else None

    def is_finished(self, step: str) -> bool:
        """Returns whether a step was finished, and its files have their sizes."""
        entry = self._finished().get(step)
        return entry is not None and self._has_sizes(entry)

    def is_intact(self, step: str) -> bool:
        """Returns whether a step was finished, and its files are as it left them."""
        entry = self._finished().get(step)
        return entry is not None and self._restore(entry)

    def digest(self, *steps: str) -> str:
        """Returns the digest of what some steps found and left: a key for those that use it."""
        finished = self._finished()
        return sha256_json([[each.key, each.result, each.files] if each else None
                            for each in map(finished.get, steps)])

    @property
    def steps(self) -> list[str]:
        """The names of all steps that were finished."""
        return list(self._finished())

    def finish(
        self, step: str, result: JsonRecord | Mapping[str, Any] | None = None,
        paths: Iterable[Path] = (),
    ) -> None:
        """Records a step with its result and its files: `paths`, and what lies below folders."""
        names = [file.relative_to(self._folder).as_posix() for path in paths
                 for file in (sorted(path.rglob("*")) if path.is_dir() else [path])
                 if file.is_file()]
        files = {name: [(self._folder / name).stat().st_size, crc32(self._folder / name)]
                 for name in names}
        self.append(step, flush=True, files=files, key=self._key, result=(
            result.to_json() if isinstance(result, JsonRecord) else result))

    def forget(self, *steps: str) -> None:
        """Takes steps back, if they are finished."""
        for step in set(steps) & self._finished().keys():
            self.append(step, key=self._key)

    def find_damage(self) -> str:
        """Returns the first step with a damaged file; empty without one."""
        return next(self.list_damage(), "")

    def list_damage(self) -> Iterator[str]:
        """Yields the steps with a damaged file.

        Bytes that were appended since to a file that grows are cut off, as is half a line.
        """
        self._cut_off_half_line()
        yield from (step for step, history in self._known().items()
                    if history.last.key == self._key and self._is_damaged(history))

    def append(self, step: str, *, flush: bool = False, **values: Any) -> None:
        """Adds a line in one write, so that lines of several threads do not mix."""
        text = json.dumps({"step": step, **values}, allow_nan=False)[:-1]
        line = f"{text}{_CRC}{zlib.crc32(text.encode())}}}\n".encode()
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
        descriptor = os.open(self._log, flags, 0o666)
        try:
            os.write(descriptor, line)
            if flush:
                os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def refuse_damaged_log(self) -> None:
        """Raises ValueError where the log is missing, not a plain file, or has a damaged line."""
        if not is_plain_file(self._log):
            raise ValueError(f"{self._log} is not a plain file")
        for number, line in enumerate(self._lines(), start=1):
            if not _is_whole(line):
                raise ValueError(f"{self._log}, line {number}, is damaged")

    def _lines(self) -> list[bytes]:
        return self._log.read_bytes().split(b"\n")[:-1] if is_plain_file(self._log) else []

    def _known(self) -> dict[str, _History]:
        """Returns the steps by name; a damaged line voids all before it."""
        histories: dict[str, _History] = {}
        for line in self._lines():
            if not _is_whole(line):
                histories.clear()
                continue
            value = json.loads(line)
            history, state = histories.setdefault(value["step"], _History()), value.get("state")
            if state != "there":
                entry = _Entry(value.get("files"), value.get("key", ""), value.get("result"),
                               grows=state == "grows")
                history.states = [entry, *history.states[:1]] if state else [entry]
            history.pending = state == "begun"
        return histories

    def _finished(self) -> dict[str, _Entry]:
        return {step: history.last for step, history in self._known().items()
                if history.last.files is not None and history.last.key == self._key}

    def _has_sizes(self, entry: _Entry) -> bool:
        paths = {self._folder / name: size for name, (size, _) in (entry.files or {}).items()}
        return all(path.is_file() and path.stat().st_size == size for path, size in paths.items())

    def _is_damaged(self, history: _History) -> bool:
        there = any(os.path.lexists(self._folder / name)
                    for state in history.states for name in state.files or ())
        return not any(map(self._restore, history.states) if there else [history.allows_missing()])

    def _restore(self, entry: _Entry) -> bool:
        """Returns whether the files are as an entry says; bytes appended since are cut off."""
        for name, (size, crc) in (entry.files or {}).items():
            path = self._folder / name
            if path.is_symlink() or not path.is_file():
                return False
            now = path.stat().st_size
            if now < size or (now > size and not entry.grows) or crc32(path, size) != crc:
                return False
            if now > size:
                os.truncate(path, size)
        return entry.files is not None

    def _cut_off_half_line(self) -> None:
        if is_plain_file(self._log):
            content = self._log.read_bytes()
            if not content.endswith(b"\n"):
                os.truncate(self._log, content.rfind(b"\n") + 1)


def _is_whole(line: bytes) -> bool:
    text, _, crc = line.rpartition(_CRC.encode())
    return crc == b"%d}" % zlib.crc32(text)


def log_path(folder: Path) -> Path:
    """Returns where the steps of a stage's folder are recorded."""
    return folder.with_name(folder.name + SUFFIX)


def start(folder: Path) -> None:
    """Begins to record the files below a folder of unfinished work."""
    log_path(folder).write_bytes(b"")


def expect(path: Path, temporary: Path) -> None:
    """Records that `path` is about to get the content of `temporary`, if files are recorded there.
    """
    size = temporary.stat().st_size
    _append_file(path, "begun", lambda: [size, crc32(temporary, size)])


def confirm(path: Path) -> None:
    """Records that `path` is in place."""
    _append_file(path, "there")


def expect_removal(path: Path) -> None:
    """Records that `path` is about to be deleted."""
    _append_file(path, "gone")


def expect_growth(path: Path) -> None:
    """Records the content of `path` now; lines appended to it later do not count."""
    def digest() -> list[int]:
        durable.flush(path)
        size = path.stat().st_size
        return [size, crc32(path, size)]

    _append_file(path, "grows", digest)


def find_damage(folder: Path) -> str:
    """Describes the damage of a stage's unfinished work; empty if a run can continue it.

    Files without a digest were not finished and are deleted.
    """
    work = StepFolder(folder, log_path(folder))
    try:
        work.refuse_damaged_log()
    except ValueError:
        return f"{log_path(folder).name} is missing or damaged"
    known = work.steps
    for path in _files_below(folder):
        if path.relative_to(folder).as_posix() not in known:
            path.unlink()
    damaged = work.find_damage()
    return f"{damaged} is missing or damaged" if damaged else ""


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


def _append_file(path: Path, state: str, digest: Callable[[], list[int]] | None = None) -> None:
    """Adds a line on a file, where a stage's folder with a log holds it."""
    for folder in path.parents:
        if folder.parent.name == PARTIAL:
            name, log = path.relative_to(folder).as_posix(), log_path(folder)
            if is_plain_file(log) and not name.startswith(f"{JOBS}/"):
                files = {"files": {name: digest()}} if digest else {}
                StepFolder(folder, log).append(name, flush=state != "there", state=state, **files)
            return


def _files_below(folder: Path) -> Iterator[Path]:
    """Yields all but folders below a folder, without those of jobs; links are not followed."""
    for parent, folders, files in os.walk(folder):
        if Path(parent) == folder and JOBS in folders and not (folder / JOBS).is_symlink():
            folders.remove(JOBS)
        for name in [*files, *(name for name in folders if (Path(parent) / name).is_symlink())]:
            yield Path(parent) / name
