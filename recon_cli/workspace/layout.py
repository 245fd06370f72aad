"""The folder that holds every result: its layout, and how a result replaces the one before.

A stage writes into `.partial/<stage>/`. When it is done, its files are flushed, its manifest is
written last, and two renames put it in place: the old result to `.old/`, the new one to where the
old one was. Killed between any two of these steps, the next writer finds either the old or the new
result and completes what was begun.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import socket
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from recon_cli.errors import FormatError, ManifestError, ReconError, WorkspaceError
from recon_cli.workspace import manifest
from recon_cli.workspace.atomic import clear_leftovers, read_json, sync_folder, write_json
from recon_cli.workspace.digests import FileDigest, digest_file
from recon_cli.workspace.manifest import Manifest, PartialRun, ResultKey, describe_progress

LOG = "recon.log"
LOCK = ".lock"  # dropped by the system when its holder dies
HOLDER = ".lock.json"  # beside the lock, because a locked file cannot be read everywhere
BLOCKS = "blocks"  # workspaces of `recon train --blocks`, by number
SEEDS = "seeds"  # workspaces of `recon eval --seeds`, by seed

logger = logging.getLogger("recon")


class Workspace:
    """Results by stage name below one folder."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()

    @property
    def holds_results(self) -> bool:
        """Whether a capture was read in here."""
        return (self.root / "ingest" / "manifest.json").is_file()

    def folder(self, stage: str) -> Path:
        """Returns where a stage's finished result lies or will lie."""
        return self.root / stage

    def partial(self, stage: str) -> Path:
        """Returns where a stage writes before it is finished."""
        return self.root / ".partial" / stage

    def _old(self, stage: str) -> Path:
        return self.root / ".old" / stage

    def _record(self, stage: str) -> Path:
        return self.partial(stage).with_suffix(".json")

    @contextmanager
    def writing(self, verb: str) -> Iterator[None]:
        """Holds the workspace for `verb`, after recovering from a crash.

        Raises:
            WorkspaceError: another process holds it, or it cannot be made.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WorkspaceError(
                f"The workspace {self.root} cannot be made: {error.strerror}.",
                hint="Give another folder with -w.") from error
        with hold_lock(self.root, verb):
            self.recover()
            yield

    def manifest(self, stage: str) -> Manifest | None:
        """Returns the manifest of a stage's result, or None where there is none.

        Raises:
            ManifestError: there is one that cannot be trusted.
        """
        folder = self.folder(stage)
        return Manifest.read(folder) if (folder / manifest.NAME).exists() else None

    def partial_run(self, stage: str) -> PartialRun | None:
        """Returns how far an interrupted run of a stage came, or None."""
        return PartialRun.read(self._record(stage)) if self.partial(stage).is_dir() else None

    def begin(self, key: ResultKey) -> tuple[Path, PartialRun]:
        """Returns the folder for a stage to write in, and how far an identical run came before.

        Files of an interrupted run are kept only if it had the same key.

        Raises:
            WorkspaceError: a folder that is no result has the name of the stage.
        """
        self._refuse_foreign(key.stage)
        partial, earlier = self.partial(key.stage), self.partial_run(key.stage)
        if earlier and earlier.key.fingerprint == key.fingerprint:
            progress = describe_progress(earlier.done, earlier.total)
            logger.info("%s: resuming (%s)", key.stage, progress)
            clear_leftovers(partial)
        else:
            if earlier:
                logger.info("%s: unfinished work for other settings is discarded", key.stage)
            self.discard(key.stage)
            earlier = PartialRun(key)
            partial.mkdir(parents=True)
            earlier.write(self._record(key.stage))
        return partial, earlier

    def record(self, partial_run: PartialRun) -> None:
        """Writes how much of a run would survive a crash."""
        partial_run.write(self._record(partial_run.key.stage))

    def discard(self, stage: str) -> None:
        """Removes unfinished work of a stage."""
        # The record goes first: without it the rest counts for nothing.
        remove(self._record(stage))
        remove(self.partial(stage))

    def seal(self, stage: str, *, without: Collection[str] = ()) -> dict[str, FileDigest]:
        """Flushes what a stage wrote and returns the digest of every file, by relative path.

        Files `without` are in its folder, but not of its making.
        """
        folder = self.partial(stage)
        outputs = {}
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder).as_posix()
            if name in without:
                continue
            _flush(path)
            if path.is_file():
                outputs[name] = digest_file(path)
        return outputs

    def commit(self, finished: Manifest) -> None:
        """Puts the sealed files of a stage in the place of its old result."""
        stage = finished.key.stage
        finished.write(self.partial(stage))
        sync_folder(self.partial(stage))
        self._swap(stage)

    def _swap(self, stage: str) -> None:
        """Renames the old result away and the new one into place; any prefix can be resumed."""
        self._retire(stage)
        partial = self.partial(stage)
        partial.rename(self.folder(stage))
        sync_folder(self.root)
        sync_folder(partial.parent)
        remove(self._record(stage))
        remove(self._old(stage))

    def _retire(self, stage: str) -> None:
        """Renames a stage's result to .old/, where it may be removed at any time."""
        self._refuse_foreign(stage)
        folder, old = self.folder(stage), self._old(stage)
        if folder.exists():
            old.parent.mkdir(exist_ok=True)
            remove(old)
            folder.rename(old)
            sync_folder(old.parent)

    def recover(self) -> None:
        """Completes or undoes what a crash interrupted, stage by stage."""
        for partial in _folders(self.root / ".partial"):
            if _complete(partial):
                logger.info("%s: finishing what a crash interrupted", partial.name)
                self._swap(partial.name)
        for old in _folders(self.root / ".old"):
            if not self.folder(old.name).exists() and _complete(old):
                logger.info("%s: restoring the result from before a crash", old.name)
                old.rename(self.folder(old.name))
                sync_folder(self.root)
            else:
                remove(old)

    def remove(self, stage: str) -> None:
        """Removes a stage's result as a whole; raises WorkspaceError where the folder is none."""
        self._retire(stage)
        remove(self._old(stage))

    def scraps(self) -> list[Path]:
        """Returns what no finished result needs: unfinished work, old results, blocks, seeds."""
        return [path for parent in (".partial", ".old", SEEDS, BLOCKS)
                for path in sorted(self.root.glob(f"{parent}/*"))]

    def _refuse_foreign(self, stage: str) -> None:
        """Refuses to replace a folder that is not ours: -w may point anywhere."""
        folder = self.folder(stage)
        if folder.exists() and not (folder / manifest.NAME).exists():
            raise WorkspaceError(
                f"{folder} is in the way: recon did not make it, for it holds no {manifest.NAME}.",
                hint="Move or delete it, or give another workspace with -w.")


def size_of(path: Path) -> int:
    """Returns the bytes in a file or in all files below a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if not file.is_dir())


@contextmanager
def disk_errors(root: Path, doing: str) -> Iterator[None]:
    """Turns errors for want of space or permission in a workspace into a WorkspaceError."""
    try:
        yield
    except OSError as error:
        raise _explain(error, root, doing) from error


def _explain(error: OSError, root: Path, doing: str) -> ReconError | OSError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        place = next(path for path in (root, *root.parents) if path.exists())
        free = shutil.disk_usage(place).free / 1e6
        return WorkspaceError(
            f"The disk is full while {doing}: {free:.0f} MB free at {root}.",
            hint="Free some space and run the same command again; finished work is kept.")
    if error.errno == errno.EFBIG:  # a limit of the process, or of a file system such as FAT32
        return WorkspaceError(
            f"A file is larger than {root} can hold, while {doing}.",
            hint="Give a workspace on another disk with -w, or raise `ulimit -f`.")
    inside = error.filename is None or Path(os.fsdecode(error.filename)).is_relative_to(root)
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS) and inside:
        return WorkspaceError(
            f"The workspace is not writable while {doing}: {error}.",
            hint=f"Check the permissions of {root}, or give another workspace with -w.")
    return error


def _folders(parent: Path) -> list[Path]:
    return sorted(path for path in parent.iterdir() if path.is_dir()) if parent.is_dir() else []


def _complete(folder: Path) -> bool:
    """Returns whether a folder holds a manifest that can be trusted: it is written last."""
    try:
        return (folder / manifest.NAME).exists() and bool(Manifest.read(folder))
    except ManifestError:
        return False


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Removes a file or a folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def hold_lock(root: Path, verb: str, *, other: str = "another workspace with -w") -> Iterator[None]:
    """Holds the lock of the workspace at `root` for as long as the block runs.

    Raises:
        WorkspaceError: another process holds the lock; the message says which.
    """
    lock = FileLock(root / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise WorkspaceError(
            f"{root} is in use by {_describe_holder(root)}.",
            hint=f"Wait until it is done, or give {other}.") from error
    try:
        write_json(root / HOLDER, {
            "pid": os.getpid(), "host": socket.gethostname(), "verb": verb,
            "since": datetime.now().astimezone().isoformat(timespec="seconds")})
        yield
    finally:
        with contextlib.suppress(OSError):  # the error that led here says more
            (root / HOLDER).unlink(missing_ok=True)
        lock.release()


def _describe_holder(root: Path) -> str:
    try:
        holder = read_json(root / HOLDER)
        return (f"`recon {holder['verb']}`, process {holder['pid']} on {holder['host']} "
                f"since {holder['since']}")
    except (FormatError, KeyError, TypeError):
        return "another process"
