"""Kills and signals at random moments of every verb; the same command must then finish the work."""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from pathlib import Path

from case import Case
from forked import Finished
from judge import (
    INTERRUPTED,
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
from lab import FULL, STAGES
from moments import Moments, sending

VERBS = ("ingest", "denoise", "sfm", "train", "prune", "eval", "export", "render", "report",
         "status", "clean", "import", "run", "train --prune")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def _set_up(case: Case, verb: str) -> tuple[Path, tuple[str, ...], Path, set[str]]:
    """Returns the workspace, what to type, the right result and what of it counts."""
    lab = case.lab
    if verb == "import":
        workspace, right = case.folder / "ws", lab.root / "imported"
        words = ("import", str(lab.splats("ply")), "-w", str(workspace))
        return workspace, words, right, {"train"}
    if verb == "run":
        workspace = case.folder / "ws"
        workspace.mkdir()
        (workspace / "recon.toml").write_bytes((lab.tiny / "recon.toml").read_bytes())
        words = ("run", str(lab.clip), "--set", "prune.at=end", "--format", "ply", "-w",
                 str(workspace))
        return workspace, words, lab.tiny, set(STAGES)
    if verb == "train --prune":
        workspace = case.workspace(without=("train", "prune"))
        words = ("train", "--prune", "-w", str(workspace))
        return workspace, words, lab.root / "mid", {"train", "prune"}
    tops = {"clean": set(STAGES) - {"sfm"}, "sfm": {"sfm", "place"}, "train": {"train"}}.get(
        verb, owned(verb))
    again = case.rng.random() < 0.4
    without = () if again or verb in ("status", "clean") else tuple(tops)
    if verb == "clean":
        stage = case.rng.choice(STAGES)
        workspace = case.workspace(lab.half(stage))
        tops = {name for name in STAGES if (workspace / name).is_dir()} - {"sfm"}
        words: Sequence[str] = ("clean",)
    else:
        workspace = case.workspace(without=without)
        words = [word for word in FULL[verb] if again or word != "--again"]
        if verb == "ingest" and not again:
            words = ["ingest", str(lab.clip)]
    return workspace, (*words, "-w", str(workspace)), lab.tiny, tops


def _moments_of(case: Case, verb: str) -> int:
    known = case.lab.moments
    names = {"run": STAGES, "train --prune": ("train", "prune")}.get(verb, (verb,))
    return sum(known.get("eval" if name == "evaluate" else name, 40) for name in names)


def _seconds_of(case: Case, verb: str) -> float:
    known = case.lab.seconds
    names = {"run": STAGES, "train --prune": ("train", "prune")}.get(verb, (verb,))
    return sum(known.get("eval" if name == "evaluate" else name, 0.5) for name in names)


def kill(case: Case) -> Verdict:
    """SIGKILL at a random change of a file, or at a random time."""
    verb = str(case.pick(VERBS))
    workspace, words, right, tops = _set_up(case, verb)
    before = snapshot(workspace)
    if case.rng.random() < 0.7:
        moments, at = Moments(workspace), 1 + case.rng.randrange(max(1, _moments_of(case, verb)))
        case.tell(f"SIGKILL at change {at}")
        case.finish(case.start(*words, moments=moments, at=at, act=sending(signal.SIGKILL)))
    else:
        seconds = case.rng.uniform(0, 1.1 * _seconds_of(case, verb))
        case.tell(f"SIGKILL after {seconds:.2f} s")
        running = case.start(*words)
        if not running.wait(seconds):
            running.signal(signal.SIGKILL)
        case.finish(running)
    killed = case.ran[-1]
    if killed.orphans:
        return wrong(Outcome.CRASH, killed, f"processes outlived it: {killed.orphans}")
    if gone := vanished(before, workspace, removed=words[1:]):
        return wrong(Outcome.LOST, None, f"after the kill {gone} are gone")
    return _finish_after(case, verb, words, workspace, right, tops, before)


def _finish_after(case: Case, verb: str, words: Sequence[str], workspace: Path, right: Path,
                  tops: set[str], before: dict[str, str]) -> Verdict:
    """Runs the same command again; its result must be that of a run without a fault."""
    if case.rng.random() < 0.3:
        status = case.run("status", "-w", str(workspace))
        if status.code:
            return broken(status) or wrong(Outcome.BUG, status, "status fails after a kill")
    done = case.run(*words)
    if bad := broken(done):
        return bad
    if done.code:
        return wrong(Outcome.BUG, done, "the same command does not finish the work")
    if lost := lost_files(before, workspace, spares(verb.split()[0], words)):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if wrongs := differing(case.lab, workspace, sorted(tops), right=right):
        return wrong(Outcome.SILENTLY_WRONG, done, f"not as without a kill: {wrongs[:5]}")
    left = [path for kind in ("*.tmp*", ".*.tmp*", ".partial/*/", ".old/*", ".lock.json")
            for path in workspace.glob(kind)]
    if left and verb not in ("status", "report"):
        return wrong(Outcome.BUG, done, f"left behind: {[path.name for path in left][:5]}")
    return RIGHT


def interrupt(case: Case) -> Verdict:
    """SIGINT, SIGTERM or SIGHUP at a random moment: one line, the right exit code, resumable."""
    verb = str(case.pick(VERBS))
    number = SIGNALS[case.turn % 3 if case.turn % len(VERBS) % 3 else case.rng.randrange(3)]
    workspace, words, right, tops = _set_up(case, verb)
    before = snapshot(workspace)
    at = 1 + case.rng.randrange(max(1, _moments_of(case, verb)))
    case.tell(f"{number.name} at change {at}")
    done = case.finish(case.start(
        *words, moments=Moments(workspace), at=at, act=sending(number)))
    return _fault_of_signal(done, number) or _finish_after(
        case, verb, words, workspace, right, tops, before)


def _fault_of_signal(done: Finished, number: int) -> Verdict | None:
    """Returns what is wrong about how a command ended upon a signal."""
    if done.code == 0:  # it was done already
        return broken(done)
    if done.code == -number:
        return wrong(Outcome.CRASH, done, f"died by signal {number}")
    if bad := broken(done):
        return bad
    if done.code != INTERRUPTED[number]:
        clear = clear_error(done)
        return wrong(Outcome.BUG, done, f"exit code {done.code} after signal {number}") if (
            not clear.fine) else wrong(Outcome.NO_HINT, done, f"an error after signal {number}")
    lines = [line for line in done.err.replace("\r", "\n").splitlines() if "interrupted" in line
             or "again" in line]
    if not lines or "*** SIG" in done.err or "@     0x" in done.err:
        return wrong(Outcome.BUG, done, "does not say in a line that it was interrupted")
    return None


def process_signal(case: Case) -> Verdict:
    """Signals to real processes of Python, at random times; nothing may outlive them."""
    verb = ("sfm", "train", "ingest", "eval", "batch", "view", "sfm")[case.turn % 7]
    number = (*SIGNALS, signal.SIGKILL)[(case.turn // 7 + case.turn) % 4]
    if verb == "batch":
        out = case.folder / "out"
        words: Sequence[str] = ("batch", str(case.lab.clip), "--out", str(out), "--set",
                                "ingest.frames=8", "--set", "train.iterations=40", "--set",
                                "train.max_size=96", "--set", "train.max_gaussians=500")
        workspace = None
    elif verb == "view":
        workspace = case.workspace()
        port = str(20000 + case.rng.randrange(20000))
        words = ("view", "--no-open", "--port", port, "-w", str(workspace))
    else:
        workspace, words, _, _ = _set_up(case, verb)
    seconds = case.rng.uniform(1.5, 9)
    case.tell(f"{number.name} after {seconds:.2f} s of `recon {' '.join(words)}`")
    before = snapshot(workspace) if workspace else {}
    running = case.start_process(*words)
    if not running.wait(seconds):
        running.signal(number)
    begin = time.monotonic()
    done = case.finish(running, 60)
    if done.orphans:
        return wrong(Outcome.CRASH, done, f"processes outlived it: {done.orphans}")
    if done.timed_out:
        return wrong(Outcome.HANG, done, f"{time.monotonic() - begin:.0f} s after the signal")
    if number != signal.SIGKILL and (bad := _fault_of_signal(done, number)):
        return bad
    if workspace and (gone := vanished(before, workspace, removed=words)):
        return wrong(Outcome.LOST, done, f"{gone} are gone")
    if workspace and verb != "view":
        after = case.run(*words)
        return broken(after) or (clear_error(after) if after.code else RIGHT)
    return RIGHT
