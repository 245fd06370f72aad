"""Full disks of random sizes: exit code 7, nothing finished lost, and the work resumes with space.

A small tmpfs in a mount namespace of its own where root may mount, else a limit on the size of
files.
"""

from __future__ import annotations

import ctypes
import os
import resource
from collections.abc import Callable, Sequence
from pathlib import Path

from case import Case
from forked import Finished
from judge import (
    RIGHT,
    Outcome,
    Verdict,
    broken,
    clear_error,
    differing,
    lost_files,
    owned,
    snapshot,
    spares,
    vanished,
    wrong,
)
from lab import FULL, copy

_VERBS = ("ingest", "denoise", "sfm", "train", "prune", "eval", "export", "render", "report",
          "import")
_NEWNS, _PRIVATE, _REC, _REMOUNT = 0x20000, 1 << 18, 1 << 14, 32
_PAGE = 4096


def mount(folder: Path, size: int, *, again: bool = False) -> bool:
    """Mounts a tmpfs of so many bytes, or changes its size; returns whether that is allowed."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not again and (libc.unshare(_NEWNS) or libc.mount(
            b"none", b"/", None, _PRIVATE | _REC, None)):
        return False
    return libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", _REMOUNT if again else 0,
                      f"size={size}".encode()) == 0


def can_mount(folder: Path) -> bool:
    """Returns whether this process may mount a tmpfs; tried in a child."""
    pid = os.fork()
    if pid == 0:
        os._exit(not mount(folder, 1 << 20))
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def _pages(folder: Path) -> int:
    """Returns about how many bytes a tmpfs takes for a folder."""
    return sum(_PAGE + (-(-path.lstat().st_size // _PAGE) * _PAGE if path.is_file() else 0)
               for path in folder.rglob("*"))


def _words(case: Case, verb: str, workspace: Path) -> tuple[tuple[str, ...], set[str], Path]:
    """Returns what to type, the names that count, and the right result."""
    lab = case.lab
    if verb == "import":
        return ("import", str(lab.splats("ply")), "-w", str(workspace)), {"train"}, (
            lab.root / "imported")
    words = [word for word in FULL[verb] if word != "--again"]
    if verb == "ingest":
        words.append(str(lab.clip))
    tops = {"sfm": {"sfm", "place"}, "train": {"train"}}.get(verb) or owned(verb)
    return (*words, "-w", str(workspace)), tops, lab.tiny


def full_disk(case: Case) -> Verdict:
    """A disk that is full after a random share of what a verb writes."""
    verb = str(case.pick(_VERBS))
    disk = case.folder / "disk"
    disk.mkdir()
    mounted = mount(disk, 1 << 30)
    workspace = disk / "ws"
    words, tops, right = _words(case, verb, workspace)
    if verb == "import":
        workspace.mkdir()
    else:
        copy(case.lab.tiny, workspace, without=sorted(tops))
    need = sum(_pages(right / top) if (right / top).is_dir() else (right / top).stat().st_size
               for top in tops)
    extra = int(case.rng.uniform(0, 1.3) * need)
    if mounted:
        statistics = os.statvfs(disk)
        used = (statistics.f_blocks - statistics.f_bfree) * statistics.f_frsize
        mount(disk, used + extra, again=True)
        case.tell(f"{verb} on a tmpfs with {extra} bytes free; it needs about {need}")
        done = case.run(*words)
    else:
        most = max(1, int(case.rng.uniform(0, 1) ** 3 * (1 << 20)))
        case.tell(f"{verb} with files of at most {most} bytes, as no tmpfs can be mounted")
        done = case.run(*words, prepare=lambda: resource.setrlimit(
            resource.RLIMIT_FSIZE, (most, most)))
    return _judge(case, verb, words, workspace, tops, right, done, lambda: mounted and mount(
        disk, 1 << 30, again=True))


def limited_files(case: Case) -> Verdict:
    """No file larger than a random size, as of `ulimit -f` and of old file systems."""
    verb = str(case.pick(_VERBS))
    workspace = case.folder / "ws"
    words, tops, right = _words(case, verb, workspace)
    if verb != "import":
        copy(case.lab.tiny, workspace, without=sorted(tops))
    sizes = sorted({path.stat().st_size for top in tops for path in (
        [right / top] if (right / top).is_file() else (right / top).rglob("*"))
        if path.is_file()})
    most = max(1, int(case.rng.choice(sizes) * case.rng.uniform(0.3, 1.05)))
    case.tell(f"{verb} with files of at most {most} bytes")
    done = case.run(*words, prepare=lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (most, most)))
    return _judge(case, verb, words, workspace, tops, right, done, lambda: None)


def _judge(case: Case, verb: str, words: Sequence[str], workspace: Path, tops: set[str],
           right: Path, done: Finished, free: Callable[[], object]) -> Verdict:
    before = {} if verb == "import" else snapshot(case.lab.tiny)
    before = {name: digest for name, digest in before.items() if name.split("/")[0] not in tops}
    if lost := lost_files(before, workspace, spares(verb)):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if gone := vanished(before, workspace):
        return wrong(Outcome.LOST, done, f"{gone} are gone")
    if done.code:
        if bad := broken(done):
            return bad
        verdict = clear_error(done)
        if done.code != 7:
            return wrong(Outcome.BUG, done, "the exit code for a full disk is 7")
        if not verdict.fine:
            return verdict
    free()
    after = case.run(*words)
    if bad := broken(after):
        return bad
    if after.code:
        return wrong(Outcome.BUG, after, "fails although there is space again")
    if wrongs := differing(case.lab, workspace, sorted(tops), right=right):
        return wrong(Outcome.SILENTLY_WRONG, after, f"not as with enough space: {wrongs[:5]}")
    return RIGHT if not done.code else Verdict(Outcome.CLEAR_ERROR)


