"""Places and circumstances: other versions, odd environments, clocks, renamed folders, batches."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import pwd
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from case import Case
from damages import DAMAGES
from judge import (
    CLEAR_CODES,
    RIGHT,
    Outcome,
    Verdict,
    broken,
    differing,
    lost_files,
    new_notices,
    owned,
    snapshot,
    spares,
    wrong,
)
from lab import FULL, LIMIT, SETTINGS, STAGES
from moments import Moments
from structure_kinds import resign

from recon_cli.kernels.kernel import CODE, cache_folder

_READ = ("render", "eval", "export", "report", "status")  # what a scene of any version allows
_MB = 1 << 20
_SCENE = Path("train") / "splats.ply"


def _names(verb: str) -> list[str]:
    """Returns the names at the top of a workspace in which a verb leaves its own result."""
    return sorted({"sfm": {"sfm", "place"}, "train": {"train"}, "clean": set()}.get(
        verb, owned(verb)))


# ---- other versions of recon ----

def _shift(by: int) -> Callable[[dict[str, object]], None]:
    return lambda content: content.update(version=content["version"] + by)


_VERSIONS: dict[str, Callable[[dict[str, object]], object]] = {
    "older": _shift(-1), "newer": _shift(1),
    "newer schema": lambda content: content.update(schema=content["schema"] + 1),
    "an option that is gone": lambda content: content["config"].update(swarm_size=0.1),
    "without an option": lambda content: content["config"].pop(min(content["config"])),
    "another record": lambda content: content["summary"].pop(max(content["summary"]))}


def other_version(case: Case) -> Verdict:
    """A finished workspace, a stage of which another version of recon made."""
    pairs = [(stage, how) for stage in STAGES for how in _VERSIONS]
    stage, how = case.pick(pairs, stride=7919)
    workspace = case.workspace()
    resign(workspace / stage / "manifest.json", _VERSIONS[how])
    verb = case.rng.choice((*_READ, *_READ, "train", "prune", "clean"))
    words = [word for word in FULL[verb] if verb in ("eval", "export") or word != "--again"]
    case.tell(f"{stage} is {how}, then {' '.join(words)}")
    before = snapshot(workspace)
    done = case.run(*words, "-w", str(workspace))
    if bad := broken(done):
        return bad
    if lost := lost_files(before, workspace, spares(verb, words)):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if done.code and verb in _READ and how not in ("newer schema", "another record"):
        return wrong(Outcome.NO_HINT, done, "a scene of another version is out of reach")
    if done.code:
        verdict = case.judge_error(done, workspace)
        gone = snapshot(workspace).get(str(_SCENE)) != before[str(_SCENE)]
        return wrong(Outcome.LOST, done, "the hint costs the scene") if gone else verdict
    wrongs = [] if verb == "report" else differing(case.lab, workspace, _names(verb))
    if wrongs and not new_notices(case.lab, verb, done):
        return wrong(Outcome.SILENTLY_WRONG, done, f"not as of this version: {wrongs[:5]}")
    return RIGHT


# ---- what a process is given ----

def _raise_key_error(*_: object) -> None:
    raise KeyError("no entry")


def _without_home() -> None:
    os.environ.pop("HOME", None)
    pwd.getpwuid = _raise_key_error


def _close(descriptor: int, name: str) -> Callable[[], None]:
    def prepare() -> None:
        os.close(descriptor)
        setattr(sys, name, None)  # as Python starts without it

    return prepare


def _fill(descriptor: int) -> Callable[[], None]:
    return lambda: os.dup2(os.open("/dev/full", os.O_WRONLY), descriptor) and None


def _leave_folder() -> None:
    folder = tempfile.mkdtemp()
    os.chdir(folder)
    os.rmdir(folder)


def _limit(kind: int, most: int) -> None:
    resource.setrlimit(kind, (most, most))


def _limit_memory(more: int) -> None:
    """Lets this process have so many bytes beyond what it has."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _limit(resource.RLIMIT_AS, used + more)


def _without_temporary() -> None:
    os.environ["TMPDIR"] = "/nonexistent"
    tempfile.tempdir = None


def _environments(case: Case) -> dict[str, Callable[[], None]]:
    few, more = case.rng.randrange(8, 64), case.rng.randrange(16, 400) * _MB
    return {
        "no HOME and no entry of the user": _without_home,
        "stdin closed": lambda: os.close(0), "stdout closed": _close(1, "stdout"),
        "stderr closed": _close(2, "stderr"), "stdout full": _fill(1), "stderr full": _fill(2),
        "the current folder is gone": _leave_folder,
        f"{few} open files": lambda: _limit(resource.RLIMIT_NOFILE, few),
        f"{more // _MB} MB more of memory": lambda: _limit_memory(more),
        "no folder for temporary files": _without_temporary,
        "ASCII alone": lambda: sys.stdout.reconfigure(encoding="ascii"),
        "no width": lambda: os.environ.update(COLUMNS="0", TERM="dumb"), "-O": lambda: None}


def environment(case: Case) -> Verdict:
    """A command in an environment that lacks something: its result, or a typed error."""
    kinds = _environments(case)
    name = str(case.pick(list(kinds)))
    workspace = case.workspace()
    verb = case.rng.choice(("status", "report", "eval", "export", "render", "clean", "prune"))
    words = (*FULL[verb], "-w", str(workspace))
    case.tell(f"{' '.join(words)} with: {name}")
    before = snapshot(workspace)
    done = (case.finish(case.start_process(*words, flags=("-O",)), 4 * LIMIT) if name == "-O"
            else case.run(*words, prepare=kinds[name]))
    if lost := lost_files(before, workspace, spares(verb, words)):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if done.timed_out or done.code < 0 or done.code == 1 or done.orphans:
        return broken(done) or wrong(Outcome.BUG, done)
    if done.code and name in ("stderr closed", "stderr full"):  # nothing can be said there
        return RIGHT if done.code in CLEAR_CODES else wrong(Outcome.BUG, done)
    if done.code:
        return case.judge_error(done, workspace, follow=False)
    wrongs = differing(case.lab, workspace, _names(verb)) if verb != "report" else []
    return wrong(Outcome.SILENTLY_WRONG, done, f"not as elsewhere: {wrongs[:5]}") if (
        wrongs) else broken(done) or RIGHT


class _Capabilities(ctypes.Structure):
    _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32),
                ("inheritable", ctypes.c_uint32))


def _obey_permissions() -> None:
    """Takes from root the right to do what permissions forbid (Linux)."""
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    held = (_Capabilities * 2)()
    libc = ctypes.CDLL(None, use_errno=True)
    libc.capget(header, held)
    for name in ("effective", "permitted"):  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH
        setattr(held[0], name, getattr(held[0], name) & ~0b110)
    if libc.capset(header, held):
        raise OSError(ctypes.get_errno(), "capset")


def permissions(case: Case) -> Verdict:
    """A workspace, or a part of it, that may be read alone or not at all."""
    workspace = case.workspace()
    part = str(case.pick((".", ".", *STAGES, "recon.toml", "train/splats.ply")))
    mode = case.rng.choice((0o555, 0o555, 0o444, 0o000))
    verb = str(case.rng.choice(tuple(FULL)))
    path, before = workspace / part, snapshot(workspace)
    paths = [*path.rglob("*")] if path.is_dir() and mode == 0o555 else []
    for one in [*paths, path]:
        one.chmod(mode if one.is_dir() or mode != 0o555 else 0o444)
    case.tell(f"{part} has the mode {mode:o}, then {verb}")
    done = case.run(*FULL[verb], "-w", str(workspace), prepare=_obey_permissions)
    for one in [path, *paths]:
        one.chmod(0o755)
    if lost := lost_files(before, workspace, spares(verb, FULL[verb])):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if done.code:
        return case.judge_error(done, workspace, follow=False)
    return broken(done) or RIGHT


def clock(case: Case) -> Verdict:
    """Clocks that jump, and a sleep of hours: the result is the same."""
    verb = str(case.pick(("train", "sfm", "eval", "export", "ingest", "prune", "status", "render")))
    workspace = case.workspace()
    jumps = [(case.rng.randrange(1, 400), case.rng.choice((-86400, 3600, 3e8, -3600, 28800)))
             for _ in range(3)]
    slept = case.rng.randrange(1, 400)  # calls after which the machine slept for a night

    def jumping(real: Callable[[], float], steps: list[tuple[int, float]]) -> Callable[[], float]:
        calls = 0

        def now() -> float:
            nonlocal calls
            calls += 1
            return real() + sum(by for at, by in steps if calls > at)

        return now

    def prepare() -> None:
        time.time = jumping(time.time, jumps)
        time.monotonic = jumping(time.monotonic, [(slept, 28800.0)])
        time.perf_counter = jumping(time.perf_counter, [(slept, 28800.0)])

    case.tell(f"{verb} while the clock jumps {jumps} and the machine sleeps at call {slept}")
    done = case.run(*FULL[verb], "-w", str(workspace), prepare=prepare)
    if done.code:
        return case.judge_error(done, workspace)
    wrongs = differing(case.lab, workspace, _names(verb))
    return broken(done) or (
        wrong(Outcome.SILENTLY_WRONG, done, f"not as by a steady clock: {wrongs[:5]}")
        if wrongs else RIGHT)


# ---- folders that move, caches, batches ----

def renamed(case: Case) -> Verdict:
    """The workspace is renamed at a random moment; the same command finishes at its new place."""
    verb = str(case.pick(("train", "sfm", "eval", "export", "prune", "ingest", "render", "denoise",
                          "report", "clean")))
    workspace, moved = case.workspace(), case.folder / "moved"
    at = 1 + case.rng.randrange(max(1, case.lab.moments[verb]))
    case.tell(f"the workspace is renamed at change {at} of {verb}")

    def act(_process: int) -> None:
        if not moved.exists():
            os.rename(workspace, moved)

    done = case.finish(case.start(
        *FULL[verb], "-w", str(workspace), moments=Moments(workspace), at=at, act=act))
    if not moved.exists():
        return broken(done) or RIGHT
    if done.code and not (verdict := case.judge_error(done, None, follow=False)).fine:
        return verdict
    again = case.run(*FULL[verb], "-w", str(moved))
    if again.code:
        return broken(again) or wrong(Outcome.BUG, again, "does not finish at its new place")
    wrongs = [] if verb == "report" else differing(case.lab, moved, _names(verb))
    return wrong(Outcome.SILENTLY_WRONG, again, f"not as in place: {wrongs[:5]}") if wrongs else (
        broken(done) or RIGHT)


def kernel_cache(case: Case) -> Verdict:
    """A damaged file among the compiled kernels: compiled again with a notice."""
    own, cache = cache_folder(), case.folder / "cache"
    assert own is not None
    copied = Path(shutil.copytree(own, cache / "kernels" / own.name))
    names = sorted(copied.rglob(f"*{CODE}"))
    damage = str(case.pick(("flip", "flip", "cut", "empty", "grow", "text", "other", "delete")))
    path = case.rng.choice(names)
    DAMAGES[damage](path, case.rng, case.folder / "spare")
    workspace = case.workspace(without=("render",))
    case.tell(f"{damage} of {path.name}, then render")
    done = case.finish(case.start_process(
        *FULL["render"], "-w", str(workspace), environment={"RECON_CACHE_DIR": str(cache)}),
        4 * LIMIT)  # it starts anew, and may compile every kernel
    if done.code:
        return case.judge_error(done, workspace)
    wrongs = differing(case.lab, workspace, ["render"])
    return wrong(Outcome.SILENTLY_WRONG, done, f"not as by sound kernels: {wrongs[:5]}") if (
        wrongs) else broken(done) or RIGHT


def bad_batch(case: Case) -> Verdict:
    """A batch of a sound capture and bad ones: the sound one is finished, the others are named."""
    folder, out = case.folder / "in", case.folder / "out"
    folder.mkdir()
    sound = Path(shutil.copy(case.lab.clip, folder / "sound.mp4"))
    inputs = [sound]
    for at in range(1 + case.rng.randrange(2)):
        bad = Path(shutil.copy(case.lab.clip, folder / f"bad{at}.mp4"))
        DAMAGES[case.rng.choice(("cut", "empty", "text", "delete", "dangling", "folder", "fifo"))](
            bad, case.rng, case.folder / "spare")
        inputs.insert(case.rng.randrange(len(inputs) + 1), bad)
    (case.folder / "my.toml").write_text(SETTINGS)
    done = case.finish(case.start("batch", *map(str, inputs), "--out", str(out), "--config",
                                  str(case.folder / "my.toml")), 4 * LIMIT)
    if bad_end := broken(done):
        return bad_end
    try:
        ends = {row["capture"]: row for row in json.loads((out / "batch.json").read_text())[
            "captures"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        unread = isinstance(error, OSError) and error.errno == errno.ENOENT
        return case.judge_error(done, None, follow=False) if unread and done.code else wrong(
            Outcome.BUG, done, f"batch.json: {error}")
    if ends["sound"]["exit_code"] != 0 or not (out / "sound" / "export" / "splats.ply").is_file():
        return wrong(Outcome.LOST, done, f"the sound capture ended as {ends['sound']}")
    failed = [row for row in ends.values() if row["exit_code"]]
    if bool(failed) is not bool(done.code) or any(
            row["exit_code"] not in CLEAR_CODES or not row["reason"] for row in failed):
        return wrong(Outcome.BUG, done, f"the others ended as {failed}")
    return RIGHT

