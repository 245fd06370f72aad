"""Damage to every file of a finished workspace, and of those in which a stage was interrupted."""

from __future__ import annotations

import json
import re
from pathlib import Path

from case import Case
from compare import is_volatile
from damages import DAMAGES
from forked import Finished
from judge import (
    RIGHT,
    Outcome,
    Verdict,
    broken,
    clear_error,
    differing,
    lost_files,
    new_notices,
    owned,
    snapshot,
    spares,
    worst,
    wrong,
)
from lab import FULL, STAGES, VERBS

# verbs that read the result of a stage
_READERS = {
    "ingest": ("denoise", "sfm", "train", "eval"), "denoise": ("sfm", "train"),
    "sfm": ("sfm", "train", "eval"), "place": ("train", "prune", "eval", "export"),
    "train": ("prune", "eval", "export"),
    "prune": ("eval", "export", "render"), "evaluate": ("report", "status", "eval"),
    "export": ("report", "status", "export"), "render": ("render", "report"),
    "report.html": ("report",)}
_SAYS = re.compile("stale|damaged|missing|unfinished|cannot|changed|not shown|is gone")


# Stages by what they leave: sfm and train have most files that the next run continues from.
_LEFT = (*STAGES, "sfm", "sfm", "train", "prune", "ingest")


def classes(root: Path, *, below: str = "") -> list[list[Path]]:
    """Returns the files below a folder, those that differ in numbers alone together."""
    found: dict[str, list[Path]] = {}
    for path in sorted((root / below).rglob("*")):
        if path.is_file():
            name = path.relative_to(root)
            found.setdefault(re.sub(r"\d+", "#", str(name)), []).append(name)
    return list(found.values())


def finished_file(case: Case) -> Verdict:
    """One file of the finished workspace."""
    combinations = [(names, damage) for names in classes(case.lab.tiny) for damage in DAMAGES]
    names, damage = case.pick(combinations, stride=7919)
    name = case.rng.choice(names)
    workspace = case.workspace()
    DAMAGES[damage](workspace / name, case.rng, case.folder / "spare")
    top = name.parts[0]
    kind = case.rng.random()
    others = ("status", "report", "render", "clean")
    if kind < 0.4 and top in _READERS:
        verb = case.rng.choice(_READERS[top])
    elif kind < 0.65 and top in STAGES:
        verb = VERBS[top]
    else:
        verb = case.rng.choice(others)
    plain = kind >= 0.4 and case.rng.random() < 0.7
    words = [word for word in FULL[verb] if word != "--again" or not plain]
    case.tell(f"{damage}: {name}, then {' '.join(words)}")
    return judge_damage(case, workspace, name, verb, (*words, "-w", str(workspace)))


def judge_damage(case: Case, workspace: Path, name: Path, verb: str, words: tuple[str, ...]
                 ) -> Verdict:
    """Runs a command on a workspace with one damaged file, and judges what it did."""
    before = snapshot(workspace)
    done = case.run(*words)
    if bad := broken(done):
        return bad
    spare = spares(verb, words)
    if lost := lost_files(before, workspace, lambda one: spare(one) or one == str(name)):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if done.code == 0:
        return _judge_success(case, workspace, name, verb, done)
    verdict = case.judge_error(done, workspace)
    if verdict.fine and name.parts[0] in STAGES and case.rng.random() < 0.4:
        verdict = worst([verdict, repair(case, workspace, name.parts[0])])
    return verdict


def repair(case: Case, workspace: Path, stage: str) -> Verdict:
    """Makes the damaged stage again, as any user would try: right, or a clear error."""
    source = (str(case.lab.clip),) if stage == "ingest" else ()
    done = case.run(VERBS[stage], *source, "--again", "-w", str(workspace))
    if done.code:
        return broken(done) or clear_error(done)
    wrongs = differing(case.lab, workspace, [stage])
    return wrong(Outcome.SILENTLY_WRONG, done, f"made again: {wrongs[:5]}") if wrongs else RIGHT


def _judge_success(case: Case, workspace: Path, name: Path, verb: str, done: Finished) -> Verdict:
    lab, stage = case.lab, name.parts[0]
    if verb == "status":
        return _judge_status(case, workspace, name, done)
    if verb == "clean":
        return RIGHT
    wrongs = differing(lab, workspace, sorted({
        "sfm": {"sfm", "place"}, "train": {"train"}}.get(verb, owned(verb))))
    if not wrongs or new_notices(lab, verb, done):
        return RIGHT
    if verb == "report" and wrongs == ["report.html"]:
        page, right = ((root / "report.html").read_text(errors="replace").splitlines()
                       for root in (workspace, lab.tiny))
        if stage == "render" or any(_SAYS.search(line) for line in set(page) - set(right)):
            return RIGHT
    if stage in STAGES and verb == VERBS[stage] and wrongs == [str(name)] and (
            is_volatile(str(name))):
        return RIGHT
    return wrong(Outcome.SILENTLY_WRONG, done, f"not as without the damage: {wrongs[:5]}")


def _judge_status(case: Case, workspace: Path, name: Path, done: Finished) -> Verdict:
    try:
        states = {row["name"]: row["state"] for row in json.loads(done.out)["stages"]}
    except (ValueError, KeyError, TypeError):
        return wrong(Outcome.BUG, done, f"status --json printed {done.out[:200]!r}")
    stage = name.parts[0]
    if stage not in states or is_volatile(str(name)):
        return RIGHT
    now = workspace / name  # a pipe must not be read
    same = now.is_file() and now.read_bytes() == (case.lab.tiny / name).read_bytes()
    if states[stage] == "fresh" and not same and name.name != "manifest.json":
        return wrong(Outcome.SILENTLY_WRONG, done, f"{name} is damaged, but {stage} is fresh")
    return RIGHT


def unfinished_file(case: Case) -> Verdict:
    """One file that an interrupted stage left; the stage then continues, or begins anew."""
    lab = case.lab
    stage, damage = case.pick([(one, each) for one in _LEFT for each in DAMAGES], stride=7919)
    names = case.draw(classes(lab.half(stage), below=".partial"))
    name = case.draw(names)
    workspace = case.workspace(lab.half(stage))
    DAMAGES[damage](workspace / name, case.rng, case.folder / "spare")
    again = case.rng.random() < 0.25
    case.tell(f"{damage}: {name}, then {VERBS[stage]}{' --again' * again}")
    source = (str(lab.clip),) if stage == "ingest" else ()
    words = (VERBS[stage], *source, *(("--again",) * again), "-w", str(workspace))
    before = snapshot(workspace)
    looked = RIGHT
    if case.rng.random() < 0.25:
        look = case.run(case.rng.choice(("status", "report")), "-w", str(workspace))
        looked = broken(look) or (clear_error(look) if look.code else RIGHT)
    done = case.run(*words)
    spare = spares(words[0])
    if lost := lost_files(before, workspace, spare):
        return worst([looked, wrong(Outcome.LOST, done, f"changed: {lost[:5]}")])
    if done.code == 0:
        wrongs = differing(lab, workspace, [stage])
        return worst([looked, wrong(
            Outcome.SILENTLY_WRONG, done, f"not as without the damage: {wrongs[:5]}")
            if wrongs else broken(done) or RIGHT])
    verdict = worst([looked, case.judge_error(done, workspace)])
    return worst([verdict, repair(case, workspace, stage), _unblocked(case, stage, workspace)])


def _unblocked(case: Case, stage: str, workspace: Path) -> Verdict:
    """Returns whether `--again` got rid of the damage: unfinished work must never block."""
    if (workspace / stage / "manifest.json").is_file():
        return RIGHT
    return wrong(Outcome.NO_HINT, case.ran[-1], f"{stage} --again does not help")
