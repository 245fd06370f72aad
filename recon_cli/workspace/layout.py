"""The folder that holds every result: its layout, and how a result replaces the one before.

A stage writes into `.partial/<stage>/`. When it is done, its files are flushed, its manifest is
written last, and two renames put it in place: the old result to `.old/`, the new one to where the
old one was. Killed between any two of these steps, the next writer finds either the old or the new
result and completes the swap.

A folder to delete may have been replaced by a link, to a larger disk for example: the link is
removed, never its target.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import shutil
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import psutil
from filelock import FileLock, Timeout

from recon_cli.errors import FormatError, ManifestError, ReconError, WorkspaceError
from recon_cli.workspace import disk, durable, manifest, shared_folder, steps
from recon_cli.workspace.atomic import LEFTOVERS, clear_leftovers, read_json, sync_folder
from recon_cli.workspace.digests import FileDigest, digest_file
from recon_cli.workspace.manifest import (
    Manifest,
    PartialRun,
    ResultKey,
    describe_progress,
    find_changed_outputs,
    manifest_name,
)
from recon_cli.workspace.paths import is_plain_file

LOG = "recon.log"
LOCK = ".lock"  # dropped by the system when its holder dies
HOLDER = ".lock.json"  # beside the lock, because a locked file cannot be read everywhere
BLOCKS = "blocks"  # workspaces that `recon train --blocks` made before it was one stage
SEEDS = "seeds"  # workspaces of other seeds that earlier versions made
RENDERS = "render"  # folders of `recon render`, whose frames are kept to resume
_OLD = ".old"  # results that were replaced
_OLD_LOG = "steps.json"  # of the steps of earlier versions, in a stage's folder

logger = logging.getLogger("recon")


class Workspace:
    """Results by stage name below one folder."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self._manifests: dict[Path, tuple[os.stat_result, Manifest]] = {}  # as they were read

    @property
    def holds_results(self) -> bool:
        """Whether a capture was read in here."""
        return (self.root / "ingest" / "manifest.json").is_file()

    def folder(self, stage: str) -> Path:
        """Returns where a stage's finished result lies or will lie; an earlier sfm made views."""
        own, sfm = self._target(stage), self._target("sfm")
        if stage == "place" and not os.path.lexists(own) and (sfm / "undistorted").is_dir():
            return sfm
        return own

    def _target(self, stage: str) -> Path:
        """Returns where a stage's next result will lie."""
        return self.root / stage.partition(".")[0]

    def partial(self, stage: str) -> Path:
        """Returns where a stage writes before it is finished."""
        return self.root / steps.PARTIAL / stage

    def _old(self, stage: str) -> Path:
        return self.root / _OLD / stage

    def _record(self, stage: str) -> Path:
        return self.root / steps.PARTIAL / f"{stage}.json"

    @contextmanager
    def writing(self, verb: str) -> Iterator[None]:
        """Holds the workspace for `verb`, after recovering from a crash.

        Raises:
            WorkspaceError: another process holds it, or it cannot be made.
        """
        made = [path for path in (self.root, *self.root.parents) if not os.path.lexists(path)]
        make_folder(self.root, "-w")
        try:
            with hold_lock(self.root, verb), disk_errors(self.root, f"running {verb}"):
                self.recover()
                yield
        except BaseException:  # a bug and Ctrl-C leave no empty folder either
            if made:
                self._remove_if_empty(made)
            raise

    def _remove_if_empty(self, made: Sequence[Path]) -> None:
        """Removes the folders that a failed first command made, unless there is work in them."""
        with suppress(OSError):  # somebody has put a file there meanwhile
            with suppress(FileNotFoundError):
                (self.root / steps.PARTIAL).rmdir()
            if {path.name for path in self.root.iterdir()} <= {LOG, LOCK, HOLDER}:
                for name in (LOG, LOCK, HOLDER):
                    (self.root / name).unlink(missing_ok=True)
                for folder in made:
                    folder.rmdir()

    def manifest(self, stage: str) -> Manifest | None:
        """Returns the manifest of a stage's result, or None where there is none.

        Raises:
            ManifestError: there is one that cannot be trusted.
        """
        folder, name = self.folder(stage), manifest_name(stage)
        if not _has_manifest(folder, name):
            return None
        manifest = self._read_manifest(folder, name)
        return manifest if manifest.key.stage != "sfm" or stage == "sfm" else manifest.as_place()

    def _read_manifest(self, folder: Path, name: str) -> Manifest:
        """Returns a manifest, which is read again once its file is another one."""
        known = self._manifests.get(folder / name)
        try:
            now = (folder / name).stat()
        except OSError:  # which is said by whoever reads it
            return Manifest.read(folder, name)
        if known is None or not _is_same(known[0], now):
            known = self._manifests[folder / name] = now, Manifest.read(folder, name)
        return known[1]

    def partial_run(self, stage: str) -> PartialRun | None:
        """Returns how far an interrupted run of a stage came, or None."""
        folder = self.partial(stage)
        if folder.is_symlink() or not folder.is_dir():
            return None
        partial_run = PartialRun.read(self._record(stage))
        return partial_run if partial_run and partial_run.key.stage == stage else None

    def begin(self, key: ResultKey, *, own_digests: bool = False) -> tuple[Path, PartialRun]:
        """Returns the folder for a stage to write in, and how far an identical run came before.

        Files of an interrupted run are kept only if it had the same key, and none of them was
        damaged since. A stage with `own_digests` finds that out by itself.

        Raises:
            WorkspaceError: a folder that recon did not write has the name of the stage.
        """
        self._refuse_foreign(key.stage)
        partial, earlier = self.partial(key.stage), self.partial_run(key.stage)
        doubt = self._doubt(key, earlier, own_digests=own_digests)
        if earlier and not doubt:
            progress = describe_progress(earlier.done, earlier.total)
            logger.info("%s: resuming (%s)", key.stage, progress)
            clear_leftovers(partial)
            steps.remove_strange(partial)
            return partial, earlier
        if doubt:
            logger.warning("%s: unfinished work is discarded: %s", key.stage, doubt)
        self.discard(key.stage)
        fresh = PartialRun(key)
        partial.mkdir(parents=True)
        if not own_digests:
            steps.start(partial)
        fresh.write(self._record(key.stage))
        return partial, fresh

    def _doubt(self, key: ResultKey, earlier: PartialRun | None, *, own_digests: bool) -> str:
        """Returns why a run does not continue unfinished work; empty if it does, or has none."""
        partial = self.partial(key.stage)
        if earlier is None:
            return f"the record of it at {self._record(key.stage)} is missing or damaged" * (
                os.path.lexists(partial))
        if earlier.key.fingerprint != key.fingerprint:
            return "it has other settings or inputs"
        if own_digests:
            old = (partial / _OLD_LOG).exists()
            return "an earlier version of recon left it" * old
        return steps.find_damage(partial)

    def record(self, partial_run: PartialRun) -> None:
        """Writes how much of a run would survive a crash."""
        partial_run.write(self._record(partial_run.key.stage))

    def discard(self, stage: str) -> None:
        """Removes unfinished work of a stage."""
        holder = self.root / steps.PARTIAL
        if holder.is_symlink() and not self.partial_run(stage):
            holder.unlink()  # it may point to anything
            return
        # The record goes first: without it the rest counts for nothing.
        remove(self._record(stage))
        remove(self.partial(stage))
        remove(steps.log_path(self.partial(stage)))

    def seal(self, stage: str) -> dict[str, FileDigest]:
        """Flushes a stage's files and returns the digest of each, by relative path."""
        folder = self.partial(stage)
        outputs = {}
        for path in sorted(folder.rglob("*")):
            durable.flush(path)
            if path.is_file():
                outputs[path.relative_to(folder).as_posix()] = digest_file(path)
        return outputs

    def commit(self, finished: Manifest) -> None:
        """Puts the sealed files of a stage in the place of its old result."""
        stage = finished.key.stage
        finished.write(self.partial(stage))
        sync_folder(self.partial(stage))
        self._swap(stage)

    def _swap(self, stage: str) -> None:
        """Renames the old result away and the new one into place; any prefix can be resumed."""
        partial = self.partial(stage)
        if shared_folder.is_shared(stage):
            shared_folder.move_in(partial, self._target(stage))
            sync_folder(self._target(stage))
            self._old(stage).parent.mkdir(exist_ok=True)
            remove(self._old(stage))
            move(partial, self._old(stage))
        else:
            self._retire(stage)
            move(partial, self._target(stage))
        sync_folder(self.root)
        sync_folder(partial.parent)
        remove(self._record(stage))
        remove(steps.log_path(partial))
        remove(self._old(stage))

    def _retire(self, stage: str) -> None:
        """Renames a stage's result to .old/, where it may be removed at any time."""
        self._refuse_foreign(stage)
        folder, old = self._target(stage), self._old(stage)
        if not os.path.lexists(folder):
            return
        old.parent.mkdir(exist_ok=True)
        remove(old)
        if folder.is_symlink():  # moved, a relative link would point elsewhere
            target = Path(os.path.realpath(folder))  # of a loop, too
            old.symlink_to(target)
            folder.unlink()
            logger.warning("%s was a link to %s, which is left as it is", folder, target)
        else:
            move(folder, old)
        sync_folder(old.parent)

    def recover(self) -> None:
        """Completes or undoes work interrupted by a crash, stage by stage."""
        for name in (steps.PARTIAL, _OLD):
            path = self.root / name
            if (path.is_symlink() and name == _OLD) or (
                    os.path.lexists(path) and not path.is_dir()):
                path.unlink()
        for partial in _folders(self.root / steps.PARTIAL):
            if not self._record(partial.name).is_file() or not _complete(partial):
                continue
            damage = (shared_folder.find_damage(partial, self._target(partial.name))
                      if shared_folder.is_shared(partial.name) else
                      find_changed_outputs(partial, Manifest.read(partial), ()))
            if damage:
                logger.warning("%s: work interrupted by a crash was damaged since (%s), and "
                               "is discarded", partial.name, "; ".join(damage))
                self.discard(partial.name)
            else:
                logger.info("%s: finishing work that a crash interrupted", partial.name)
                self._swap(partial.name)
        for old in _folders(self.root / _OLD):
            if not self._target(old.name).exists() and _complete(old):
                logger.info("%s: restoring the result from before a crash", old.name)
                move(old, self._target(old.name))
                sync_folder(self.root)
            else:
                remove(old)

    def remove(self, stage: str) -> None:
        """Removes a stage's result; raises WorkspaceError where the folder is none."""
        if "." in stage:
            for path in self.result_paths(stage):
                remove(path)
            return
        self._retire(stage)
        remove(self._old(stage))

    def result_paths(self, stage: str) -> list[Path]:
        """Returns what is removed with a stage's result: its folder, or its files in one."""
        folder = self._target(stage)
        return shared_folder.result_paths(folder, stage) if "." in stage else [folder]

    def scraps(self) -> list[Path]:
        """Returns files that no finished result needs: unfinished work, old results, blocks, seeds.

        Where one of these folders is a link, that is the link, not its target.
        """
        parents = [self.root / name for name in (steps.PARTIAL, _OLD, SEEDS, BLOCKS)]
        return [*(path for parent in parents
                  for path in ([parent] if parent.is_symlink() else sorted(parent.glob("*")))),
                *(path for path in sorted(self.root.glob(LEFTOVERS)) if not _is_in_use(path))]

    def renders(self) -> list[Path]:
        """Returns the folders of frames that `recon render` made in here."""
        return [path for path in _folders(self.root / RENDERS)
                if (path / "render.json").is_file() and not has_link(path, self.root)]

    def _refuse_foreign(self, stage: str) -> None:
        """Refuses to replace a folder that is not ours: -w may point anywhere."""
        folder = self._target(stage)
        if folder.exists() and not _has_manifest(folder):
            raise WorkspaceError(
                f"{folder} is in the way: recon did not make it, for it holds no {manifest.NAME}.",
                hint="Move or delete it, or give another workspace with -w.")


def size_of(path: Path) -> int:
    """Returns the bytes in a file or in all files below a folder; of a link its own."""
    files = path.rglob("*") if path.is_dir() and not path.is_symlink() else [path]
    return sum(file.lstat().st_size for file in files if file.is_symlink() or not file.is_dir())


def has_link(path: Path, root: Path) -> bool:
    """Returns whether a path below `root`, or a folder between them, is a link."""
    between = [path, *path.parents]
    return any(os.path.islink(part)  # False, too, for a name that no system takes
               for part in between[:between.index(root)])


@contextmanager
def disk_errors(root: Path, doing: str) -> Iterator[None]:
    """Turns errors for want of space or permission in a workspace into a WorkspaceError.

    So it does all errors where the workspace was renamed or deleted meanwhile.
    """
    before = _identity(root)
    try:
        yield
    except WorkspaceError:
        raise
    except Exception as error:
        explained = _explain(error, root, doing) if before in (None, _identity(root)) else (
            WorkspaceError(
                f"{root} was renamed or deleted while {doing}.",
                hint="Run the same command with -w and its new place; it continues there."))
        if explained is None:
            raise
        raise explained from error


def _identity(folder: Path) -> tuple[int, int] | None:
    """Returns what a folder keeps when it is renamed, None where there is none."""
    try:
        found = folder.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _explain(error: Exception, root: Path, doing: str) -> ReconError | None:
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS) and (
            error.filename is None or Path(os.fsdecode(error.filename)).is_relative_to(root)):
        return WorkspaceError(
            f"The workspace is not readable or not writable while {doing}: {error}.",
            hint=f"Check the permissions of {root}, or give another workspace with -w.")
    return disk.explain(error, root, doing)


def _folders(parent: Path) -> list[Path]:
    return sorted(path for path in parent.iterdir() if path.is_dir()) if parent.is_dir() else []


def _is_in_use(leftover: Path) -> bool:
    """Returns whether the process that writes a file still runs: a report takes no lock."""
    number = re.search(r"\.tmp(\d+)", leftover.name)
    return number is not None and psutil.pid_exists(int(number[1]))


def _is_same(before: os.stat_result, now: os.stat_result) -> bool:
    """Returns whether a file is the one of before: replaced ones are files of their own."""
    return all(getattr(before, sign) == getattr(now, sign)
               for sign in ("st_ino", "st_size", "st_mtime_ns"))


def _has_manifest(folder: Path, name: str = manifest.NAME) -> bool:
    """Returns whether a folder has a manifest, be it a link that leads nowhere.

    PermissionError where that cannot be known: a result is not missing for that.
    """
    try:
        os.lstat(folder / name)
    except PermissionError:
        raise
    except (OSError, ValueError):
        return False
    return True


def _complete(folder: Path) -> bool:
    """Returns whether a folder holds a manifest that can be trusted: it is written last."""
    try:
        name = manifest_name(folder.name)
        return _has_manifest(folder, name) and bool(Manifest.read(folder, name))
    except ManifestError:
        return False


def remove(path: Path) -> None:
    """Removes a file, a link, or a folder with all that is in it, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def link_or_copy(source: Path, target: Path) -> None:
    """Makes `target` another name of a file, or a copy where a file system has no hard links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except (OSError, NotImplementedError):  # not every file system has hard links, nor across two
        shutil.copy2(source, target, follow_symlinks=False)


def move(source: Path, target: Path) -> None:
    """Renames a folder to where nothing is, also to another file system, atomically."""
    try:
        durable.rename(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        copy = target.with_name(f".{target.name}.moving")
        remove(copy)  # of a move that was killed
        shutil.copytree(source, copy, symlinks=True)
        for path in copy.rglob("*"):
            if not path.is_symlink():
                durable.flush(path)
        copy.rename(target)
        sync_folder(target.parent)
        remove(source)


def make_folder(folder: Path, option: str = "--out") -> None:
    """Makes a folder that an option names; WorkspaceError where it cannot be made."""
    try:
        with disk_errors(folder, "making it"):
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(f"The folder {folder} cannot be made: {error.strerror}.",
                             hint=f"Give another folder with {option}.") from error


@contextmanager
def hold_lock(root: Path, verb: str, *, other: str = "another workspace with -w") -> Iterator[None]:
    """Holds the lock of the workspace at `root` for as long as the block runs.

    Raises:
        WorkspaceError: another process holds the lock; the message says which.
    """
    if os.path.lexists(root / LOCK) and not is_plain_file(root / LOCK):
        raise WorkspaceError(
            f"{root / LOCK}, the lock, is not a plain file.", hint="Move or delete it.")
    lock = FileLock(root / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise WorkspaceError(
            f"{root} is in use by {_describe_holder(root)}.",
            hint=f"Wait until it is done, or give {other}.") from error
    try:
        _name_holder(root / HOLDER, verb)
        yield
    finally:
        with suppress(OSError):  # the error that led here says more
            (root / HOLDER).unlink(missing_ok=True)
        lock.release()


def _name_holder(path: Path, verb: str) -> None:
    """Writes who holds the lock; only the lock counts, so a full disk or a kill does not matter."""
    with suppress(OSError):
        remove(path)
        path.write_text(json.dumps({
            "pid": os.getpid(), "host": socket.gethostname(), "verb": verb,
            "since": datetime.now().astimezone().isoformat(timespec="seconds")}), encoding="utf-8")


def _describe_holder(root: Path) -> str:
    try:
        holder = read_json(root / HOLDER)
        return (f"`recon {holder['verb']}`, process {holder['pid']} on {holder['host']} "
                f"since {holder['since']}")
    except (FormatError, KeyError, TypeError):
        return "another process"
