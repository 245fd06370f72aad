"""Says how a fault ended: what a command did about it, against what was right."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import compare
from forked import Finished
from lab import STAGES, Lab, notices


class Outcome(IntEnum):
    """How a fault ended, best first."""

    RIGHT = 0
    CLEAR_ERROR = 1
    NO_HINT = 2  # an error without a hint, or with one that does not help when it is typed
    BUG = 3
    CRASH = 4
    HANG = 5
    LOST = 6
    SILENTLY_WRONG = 7

    @property
    def words(self) -> str:
        """The name in a table."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class Verdict:
    """How a fault ended, and the evidence."""

    outcome: Outcome
    detail: str = ""

    @property
    def fine(self) -> bool:
        """Whether it ended as it should."""
        return self.outcome <= Outcome.CLEAR_ERROR


RIGHT = Verdict(Outcome.RIGHT)
CLEAR_CODES = range(2, 8)
INTERRUPTED = {1: 129, 2: 130, 15: 143}  # exit code by signal
_SCRATCH = (".partial", ".old", ".lock", ".lock.json", "recon.log")
_PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|\.\.\.|--help")


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Returns the first of the worst."""
    return max(verdicts, key=lambda verdict: verdict.outcome, default=RIGHT)


def wrong(kind: Outcome, done: Finished | None, text: str = "") -> Verdict:
    """Returns a verdict with what the command said."""
    said = "" if done is None else f"{done}: {_last_words(done)}"
    return Verdict(kind, " | ".join(filter(None, [text, said])))


def _last_words(done: Finished) -> str:
    lines = [line for line in done.err.splitlines() if line.strip()]
    told = [line for line in lines if line.startswith(("error:", "hint:"))]
    return " / ".join(line[:250] for line in told or lines[-2:])


def broken(done: Finished) -> Verdict | None:
    """Returns what no command may do, whatever is wrong: hang, crash, a traceback, orphans."""
    if done.timed_out:
        return wrong(Outcome.HANG, done)
    if done.orphans:
        return wrong(Outcome.CRASH, done, f"processes outlived it: {', '.join(done.orphans)}")
    if done.code < 0 or (done.code >= 128 and done.code not in INTERRUPTED.values()):
        return wrong(Outcome.CRASH, done)
    if done.code == 1 or "Traceback (most" in done.err or "This is a bug" in done.err:
        return wrong(Outcome.BUG, done)
    return None


def clear_error(done: Finished) -> Verdict:
    """Returns whether a failure says what was found and what to type next."""
    lines = done.err.splitlines()
    told = any(line.startswith("error:") and len(line) > 10 for line in lines)
    if done.code not in CLEAR_CODES or not told:
        return wrong(Outcome.BUG, done, "not a typed error")
    if not hint_of(done):
        return wrong(Outcome.NO_HINT, done)
    return Verdict(Outcome.CLEAR_ERROR, _last_words(done))


def hint_of(done: Finished) -> str:
    """Returns the hint that a command printed, all its lines."""
    _, _, hint = done.err.partition("\nhint: ")
    return hint.strip()


def commands_in(hint: str) -> list[tuple[str, ...]]:
    """Returns the commands that a hint tells to type, without `recon`."""
    found = []
    for text in re.findall(r"`recon ([^`]+)`", hint):
        if not _PLACEHOLDER.search(text):
            try:
                found.append(tuple(shlex.split(text)))
            except ValueError:
                found.append((text,))
    return found


def follow_hint(
    done: Finished, workspace: Path | None, run: Callable[[Sequence[str]], Finished],
    retry: Callable[[], Finished],
) -> Verdict:
    """Types the first command of a hint, then the failed one again: the error must be gone."""
    verdict = clear_error(done)
    commands = commands_in(hint_of(done)) if verdict.fine else []
    if not commands:
        return verdict
    words = commands[0]
    if workspace is not None and "-w" in done.words and not {"-w", "--workspace"} & set(words) and (
            words[0] not in ("doctor", "view")):
        found = wrong(Outcome.NO_HINT, done, "the hint lacks -w")
        words = (*words, "-w", str(workspace))
    else:
        found = verdict
    tried = run(words)
    text = f"typed `recon {' '.join(words)}`"
    if (tried.code == 2 and "Usage" in tried.err + tried.out) or (tried.code == 2 and (
            "no such" in tried.err.lower())):
        return worst([found, wrong(Outcome.NO_HINT, tried, f"{text}, as the hint of {done} says")])
    if bad := broken(tried):
        return worst([bad, found])
    if tried.code:
        same = _last_words(tried) == _last_words(done)
        return worst([found, clear_error(tried), wrong(
            Outcome.NO_HINT, tried, f"{text}: the same error again") if same else RIGHT])
    after = retry()
    if after.code and _last_words(after) == _last_words(done):
        return worst([found, wrong(Outcome.NO_HINT, after, f"{text}, but nothing changed")])
    return worst([found, broken(after) or RIGHT])


def costs_training(done: Finished) -> Verdict | None:
    """Returns the verdict on a hint that trains again, or deletes, a scene that is whole.

    It counts as clear where it names the scene, or training is what was typed.
    """
    hint = hint_of(done)
    if done.words[0] in ("train", "import", "run") or "splats.ply" in hint:
        return None
    for words in commands_in(hint):
        if words[0] in ("train", "run") or (words[0] == "clean" and "train" in words):
            return wrong(Outcome.NO_HINT, done, "the hint costs a training")
    return None


def snapshot(folder: Path) -> dict[str, str]:
    """Returns the SHA-256 of every file below a folder, and where links lead, by path."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"-> {os.readlink(path)}"
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def lost_files(before: dict[str, str], folder: Path, spare: Callable[[str], bool]) -> list[str]:
    """Returns which files are gone or changed, but for those that the command may replace."""
    after = snapshot(folder)
    return [name for name, digest in before.items()
            if after.get(name) != digest and not spare(name)]


def owned(verb: str, words: Sequence[str] = ()) -> set[str]:
    """Returns the names at the top of a workspace that a verb may replace."""
    stages = {
        "ingest": {"ingest"}, "denoise": {"denoise"}, "sfm": {"denoise", "sfm", "place"},
        "train": {"denoise", "sfm", "place", "train"}, "import": {"train"}, "prune": {"prune"},
        "eval": {"evaluate"}, "export": {"export"}, "run": {*STAGES, "report.html"},
        "render": {"render"}, "report": {"report.html"}, "status": set(), "batch": set(STAGES),
        "clean": {"sfm", "blocks", "seeds", *words}}[verb]
    return stages | ({"prune"} if "--prune" in words else set())


def spares(verb: str, words: Sequence[str] = ()) -> Callable[[str], bool]:
    """Returns whether a verb may change a file of the workspace, by its relative path."""
    names = owned(verb, words) | set(_SCRATCH)
    return lambda name: name.split("/")[0] in names


def vanished(before: dict[str, str], workspace: Path, *, removed: Sequence[str] = ()) -> list[str]:
    """Returns the stages whose finished result is gone altogether."""
    return [stage for stage in STAGES if f"{stage}/manifest.json" in before
            and stage not in removed and not any(
                os.path.lexists(workspace / parent / stage / "manifest.json")
                for parent in ("", ".old", ".partial"))]


def differing(lab: Lab, workspace: Path, names: Iterable[str], *, right: Path | None = None
              ) -> list[str]:
    """Returns which files of stages (or others at the top) are not those of the right result."""
    return compare.differing(right or lab.tiny, workspace, names, made=lab.made)


def new_notices(lab: Lab, verb: str, done: Finished) -> set[str]:
    """Returns the notices that the sound command does not print."""
    return notices(done.err) - lab.notices.get(verb, set())
