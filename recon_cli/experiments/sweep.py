"""A sweep as a picture: PSNR after recovery against the share removed. Needs matplotlib."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.config.stages import PRUNE_SCORES
from recon_cli.evaluation.reference_views import MeanScore, mean_score
from recon_cli.train.fit import Report, Task, fit
from recon_cli.train.importance import Importance
from recon_cli.train.prune_run import Course
from recon_cli.train.pruning import Advance, remaining, removals, remove, scored, survivors
from recon_cli.train.state import TrainState
from recon_cli.workspace import atomic

NONE = "none"  # stands for no score where nothing is removed
_WARM_STEPS = 10  # before anything is timed: the first steps load kernels and make buffers


@dataclass(frozen=True)
class Trial:
    """One way to prune the model and what came of it.

    Attributes:
        score: its name; `none` for the controls, which remove nothing.
        ratio: share that was removed; for a control with equal seconds that of the trial whose
            seconds it takes, None for the one with equal steps.
        gaussians: that are left.
        steps: of recovery.
        seconds: of recovery and scoring.
        removed: right after the last removal; None where nothing was removed.
        recovered: at the end.
    """

    score: str
    ratio: float | None
    gaussians: int
    steps: int
    seconds: float
    removed: MeanScore | None
    recovered: MeanScore


def trials(ratios: Sequence[float]) -> int:
    """Returns how many trials a sweep makes."""
    return 1 + len(ratios) * (len(PRUNE_SCORES) + 1)


def sweep(course: Course, ratios: Sequence[float]) -> Iterator[Trial]:
    """Yields the control with equal steps, then for every ratio all scores and their control.

    Equal seconds are those of the score that the options name.
    """
    steps = course.until - course.first
    _control(course, None, min(_WARM_STEPS, steps))
    idle = _control(course, None, steps)
    yield idle
    for ratio in ratios:
        of_options = idle
        for name in PRUNE_SCORES:
            trial = _trial(course, name, ratio)
            of_options = trial if name == course.config.score else of_options
            yield trial
        share = of_options.seconds / max(idle.seconds, 1e-9)
        yield _control(course, ratio, max(1, round(share * steps)))


def _control(course: Course, ratio: float | None, steps: int) -> Trial:
    """Trains on without removing anything."""
    state, begin = course.start(), time.perf_counter()
    task = course.recovering(course.first, course.first + steps)
    advancing(task)(state, course.first + steps, None)
    seconds = time.perf_counter() - begin
    return Trial(NONE, ratio, len(state.splats), steps, seconds, None, quality(state, task))


def _trial(course: Course, name: str, ratio: float) -> Trial:
    """Prunes by one score to one ratio."""
    state, first, until = course.start(), course.first, course.until
    task, n = course.recovering(first, until), len(state.splats)
    removed, seconds = None, 0.0
    plan = removals(n, remaining(n, ratio), course.rounds, until - first)
    for removal in plan:
        begin = time.perf_counter()
        score = scored(
            state, task, first + removal.after, name=name, beta=course.config.beta,
            advance=advancing(task))
        remove(state, survivors(score, removal.count))
        seconds += time.perf_counter() - begin
    if plan:
        removed = quality(state, task)
    begin = time.perf_counter()
    advancing(task)(state, until, None)
    seconds += time.perf_counter() - begin
    return Trial(
        name, ratio, len(state.splats), until - first, seconds, removed, quality(state, task))


def advancing(task: Task) -> Advance:
    """Returns the function that trains; validation views are not looked at meanwhile."""
    blind = dataclasses.replace(task, validation=[])

    def ignore(_: TrainState | Report) -> None:
        """Keeps nothing."""

    def advance(state: TrainState, until: int, importance: Importance | None) -> None:
        fit(state, blind, until, on_step=ignore, on_report=ignore, importance=importance)

    return advance


def quality(state: TrainState, task: Task) -> MeanScore:
    """Returns the scores of a model on the validation views, of masked ones where they count."""
    degree = task.schedule.sh_degree(max(1, state.iteration))
    return mean_score(state.splats, task.validation, degree, task.backend)


def draw(found: Sequence[Trial], before: float, path: Path) -> None:
    """Draws one line a score and the controls into a .svg, whole or not at all.

    Args:
        found: the trials of a sweep.
        before: PSNR of the model before it was pruned, dB.
        path: of the picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.subplots()
    for name in dict.fromkeys(one.score for one in found if one.score != NONE):
        axes.plot(*_line(found, name), marker="o", markersize=4, label=name)
    axes.plot(*_line(found, NONE), color="0.3", linestyle="--", label="no prune, equal seconds")
    for one in found:
        if one.score == NONE and one.ratio is None:
            axes.axhline(one.recovered.psnr_db, color="0.3", label="no prune, equal steps")
    axes.axhline(before, color="0.7", linestyle=":", label="before")
    axes.set(xlabel="share of the Gaussians that was removed",
             ylabel="PSNR on the validation views after recovery, dB")
    axes.legend(fontsize=8)
    axes.grid(color="0.92")
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary)


def _line(found: Sequence[Trial], name: str) -> tuple[list[float], list[float]]:
    """Returns ratios and PSNR of the trials of a name that belong to a ratio."""
    own = [(one.ratio, one.recovered.psnr_db)
           for one in found if one.score == name and one.ratio is not None]
    return [ratio for ratio, _ in own], [value for _, value in own]
