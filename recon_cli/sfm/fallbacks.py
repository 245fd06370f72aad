"""The ways to a model, from the quickest to the last resort.

A good capture stops at the first rung. A further one is tried only where the model before it was
not good enough, and where it is expected to end in time. What was matched stays in the database: a
further rung adds pairs to it. Of all models that were found the best one is kept.

Each rung that is finished is noted, so that an interrupted run goes on behind it. A mapping that
was interrupted begins again: continued from COLMAP's snapshot of 40 of 75 frames, the sample came
out with other points, and cameras up to 0.1% of the path elsewhere. It saved 8 s.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from recon_cli.errors import SfmError
from recon_cli.sfm import (
    checks,
    database,
    mapper,
    model_selection,
    pairs,
    verdict,
)
from recon_cli.sfm import (
    pairs as retrieval,
)
from recon_cli.sfm.job import VERDICT, Job, Reporter
from recon_cli.sfm.model_selection import Candidate
from recon_cli.sfm.step_log import Ledger, Result, fresh_folder, publish
from recon_cli.sfm.weakest_cut import MIN_WEAK_LINK
from recon_cli.workspace import atomic

# Exhaustive matching grows with the square: 4950 pairs of 100 images are about a minute on two
# cores at 600x340 and still the whole graph, so that a walk around a room closes.
EXHAUSTIVE_MAX = 100
# Share of the frames that can be placed at all which a model must hold to end the search. Two rooms
# and 50 photos held all of them; a slow walk that fell into four to seven models 76 to 82%.
ENOUGH = 0.9
# How much longer than the longest rung so far a mapping may take. Relaxed thresholds took 0.8 and
# 2.3 times as long as the first mapping of a capture, the global mapper 0.5, 2 and 3 times.
SLOWER = 3.0


@dataclass(frozen=True)
class Rung:
    """One way to a model.

    Attributes:
        name: for the user.
        reason: why a capture begins with it.
        wanted: gives the pairs of images that are matched first, by file name.
        mapped: gives the models that were found.
    """

    name: str
    reason: str
    wanted: Callable[[Job], set[pairs.Pair]]
    mapped: Callable[[Job, Reporter], list[pycolmap.Reconstruction]]


@dataclass(frozen=True)
class Note:
    """What became of a rung.

    Attributes:
        name: of the rung.
        reason: why it was tried.
        seconds: that it took with its matching, 0 where it was passed over.
        skipped: why it was passed over, empty where it was tried.
        registered: frames with a camera.
        shortfall: why that is not good enough, empty where it is.
        apart: frames that only other models hold, a tuple each.
        rejected: why frames were taken out of the model, by name.
        trusted: whether the verdict trusts the model.
        weak_link: the verdict's, None where it has none.
        reprojection_error_px: mean, None without a model.
    """

    name: str
    reason: str
    seconds: float = 0.0
    skipped: str = ""
    registered: tuple[str, ...] = ()
    shortfall: str = "no model was found"
    apart: tuple[tuple[str, ...], ...] = ()
    rejected: dict[str, str] = dataclasses.field(default_factory=dict)
    trusted: bool = False
    weak_link: float | None = None
    reprojection_error_px: float | None = None

    @property
    def models(self) -> list[int]:
        """Frames in the model and in what is left of the others."""
        return [len(part) for part in (self.registered, *self.apart) if part]

    def shown(self, *, kept: bool) -> dict[str, Any]:
        """Returns the note for the stage's summary."""
        return {
            "name": self.name, "reason": self.reason, "skipped": self.skipped,
            "registered": len(self.registered), "models": self.models,
            "weak_link": self.weak_link, "reprojection_error_px": self.reprojection_error_px,
            "seconds": self.seconds, "kept": kept}


def rungs(job: Job) -> tuple[Rung, ...]:
    """Returns the ways to a model that a job allows, the quickest first."""
    count = len(job.names)
    if job.pairs != "auto":
        return (Rung(job.pairs, "it was asked for", _PAIRS[job.pairs], mapper.incremental),)
    every = Rung("exhaustive", f"{count} frames are few enough to match all pairs",
                 _PAIRS["exhaustive"], mapper.incremental)
    begin = (every,) if count <= EXHAUSTIVE_MAX else (
        Rung("retrieval", f"{count} frames are too many to match all pairs at once",
             _PAIRS["retrieval"], mapper.incremental),
        every)
    return (
        *begin,
        Rung("relaxed", "", _no_more, lambda *to: mapper.incremental(*to, relaxed=True)),
        Rung("global", "", _no_more, mapper.globally))


def match_first(job: Job, report: Reporter) -> Result:
    """Matches what the first rung wants and returns how much that is.

    Raises:
        SfmError: no pair matches, or none of them shows depth.
    """
    pairs.match(job, rungs(job)[0].wanted(job), report)
    pairs.check_motion(job)
    return pairs.counted(job)


def climb(job: Job, report: Reporter, *, deadline: float) -> Result:
    """Writes the best model of all rungs that were needed into out/model.

    Args:
        job: whose database holds the matches of the first rung.
        report: told of phases and counts.
        deadline: monotonic time in seconds at which the process is ended.

    Returns:
        What the model holds, and what became of each rung.

    Raises:
        SfmError: too few frames have a camera, they see the points from one place, or the verdict
            is that the model hangs together by too little.
    """
    ledger = Ledger(job.rungs)
    notes: list[Note] = []
    reason = rungs(job)[0].reason
    for rung in rungs(job):
        noted = ledger.result(rung.name)
        note = _read(noted) if noted else _tried(job, rung, reason, notes, report, deadline)
        if not noted:
            ledger.finish(rung.name, dataclasses.asdict(note), _folder(job, rung.name))
        notes.append(note)
        if not note.skipped:
            reason = note.shortfall
            if not reason:
                break
    return _keep(job, notes)


def reachable(job: Job, found: Candidate) -> set[str]:
    """Returns the frames that a model could hold: those with features and, once all pairs are
    matched, those that matches tie to it, directly or through others."""
    counts = database.keypoint_counts(job.database)
    textured = {name for name, count in counts.items() if count >= checks.MIN_KEYPOINTS}
    if database.progress(job.database, "matches") < len(counts) * (len(counts) - 1) // 2:
        return textured
    held = set(mapper.names(found.model))
    tied = max(found.verdict.match_parts, key=lambda part: len(held.intersection(part)))
    return textured.intersection(tied)


def shortfall(found: Candidate, reach: Collection[str]) -> str:
    """Returns why a model is not good enough, empty where it is.

    Args:
        found: the model.
        reach: frames that it could hold.
    """
    held = found.model.num_reg_images()
    if held < ENOUGH * len(reach):
        return f"only {held} of {len(reach)} frames that can be placed got a camera"
    parts = [part for part in found.apart if set(part).intersection(reach)]
    if parts:
        return f"the capture fell into {1 + len(parts)} models"
    if not found.verdict.trusted:
        return " ".join(found.verdict.problems)
    return ""


def best(notes: Sequence[Note]) -> Note | None:
    """Returns the note on the best model: the most frames that hang together best.

    A frame counts as much as the weakest link of its model holds, and as in a broken model where
    something else speaks against it; in a tie of 1% the smaller reprojection error decides, then
    the earlier rung.
    """
    def quality(note: Note) -> tuple[float, float]:
        link = note.weak_link if note.weak_link is not None else float(note.trusted)
        link = link if note.trusted else min(link, MIN_WEAK_LINK)
        most = max(len(other.registered) for other in notes)
        return (round(len(note.registered) / most * (0.5 + 0.5 * link), 2),
                -(note.reprojection_error_px or 0.0))

    found = [note for note in notes if note.registered]
    return max(found, key=quality, default=None)


def _tried(
    job: Job, rung: Rung, reason: str, before: Sequence[Note], report: Reporter, deadline: float
) -> Note:
    """Returns what becomes of a rung; its model and verdict lie in its folder."""
    folder = fresh_folder(_folder(job, rung.name))
    start = time.monotonic()
    wanted = rung.wanted(job) if before else set()  # the first ones are matched
    expected = _expected(job, len(wanted - database.pair_names(job.database)), before)
    if before and start + expected > deadline:
        return Note(rung.name, reason, skipped=f"it would take about {expected / 60:.0f} minutes")
    if wanted:
        pairs.match(job, wanted, report)
    found = model_selection.best(job, rung.mapped(job, report))
    seconds = round(time.monotonic() - start, 2)
    if found is None:
        return Note(rung.name, reason, seconds)
    _write(found, folder)
    return Note(
        rung.name, reason, seconds, "", tuple(mapper.names(found.model)),
        shortfall(found, reachable(job, found)), found.apart, dict(found.rejected),
        found.verdict.trusted, found.verdict.weak_link.share,
        found.model.compute_mean_reprojection_error())


def _expected(job: Job, count: int, before: Sequence[Note]) -> float:
    """Returns about how many seconds matching `count` pairs and mapping will take."""
    matched = Ledger(job.out).result("matches") or {"seconds": 0.0, "rows": 0}
    pace = float(matched["seconds"]) / max(1, int(matched["rows"]))
    return count * pace + SLOWER * max((note.seconds for note in before), default=0.0)


def _keep(job: Job, notes: Sequence[Note]) -> Result:
    """Publishes the best model, if it passes, and returns what the stage tells of it."""
    chosen = best(notes)
    registered = chosen.registered if chosen else ()
    try:
        checks.check_registered(job.names, registered, job.min_registered)
    except SfmError as error:
        raise SfmError(f"{error.message} {_attempts(notes)}", hint=error.hint) from error
    assert chosen is not None  # three frames at least are registered
    folder = _folder(job, chosen.name)
    model = pycolmap.Reconstruction(folder / "model")
    described = mapper.described(model)
    checks.check_parallax(described["median_triangulation_angle_deg"])
    found = verdict.examine(
        model, job.database, job.names, sharpness=job.sharpness, times=job.times)
    verdict.check_weak_link(found, job.accept_weak)
    atomic.write_json(job.out / VERDICT, found.to_json())
    publish(folder / "model", job.model)
    shutil.rmtree(job.rungs)
    return {
        **described, "poses": None,
        "models": chosen.models, "apart": [list(part) for part in chosen.apart],
        "rejected": chosen.rejected, "verdict": found.to_json(), "lines": list(found.lines()),
        "rungs": [note.shown(kept=note is chosen) for note in notes]}


def _attempts(notes: Sequence[Note]) -> str:
    """Returns a sentence on how many cameras each way found."""
    counts = (f"{note.name} found {len(note.registered)}" if not note.skipped else
              f"{note.name} was passed over for want of time" for note in notes)
    return f"Cameras by way of mapping: {', '.join(counts)}."


def _write(found: Candidate, folder: Path) -> None:
    (folder / "model").mkdir()
    found.model.write(folder / "model")


def _folder(job: Job, name: str) -> Path:
    return job.rungs / name


def _read(value: Result) -> Note:
    return Note(**{
        **value, "registered": tuple(value["registered"]),
        "apart": tuple(map(tuple, value["apart"]))})


def _no_more(_job: Job) -> set[pairs.Pair]:
    return set()


def _near_or_alike(job: Job) -> set[pairs.Pair]:
    """Returns the neighbours among the frames of each camera, and frames that look alike."""
    near = set().union(*(pairs.sequential(group.names) for group in job.groups))
    return near | retrieval.similar(job.database, job.names, seed=job.seed, besides=near)


_PAIRS: dict[str, Callable[[Job], set[pairs.Pair]]] = {
    "exhaustive": lambda job: pairs.exhaustive(job.names),
    "sequential": lambda job: pairs.sequential(job.names),
    "retrieval": _near_or_alike,
}
