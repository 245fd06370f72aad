"""`recon prune --sweep`: quality after pruning by every score to every ratio, beside controls.

The controls remove nothing: one takes as many steps, the others as many seconds. sweep.json and
sweep.svg lie in the workspace beside the stages, so that no result of a stage turns stale.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.config.stages import PRUNE_SCORES, PruneConfig
from recon_cli.context import StageInputs
from recon_cli.errors import TrainingError
from recon_cli.evaluation.reference_views import MeanScore, mean_score
from recon_cli.evaluation.tables import Table
from recon_cli.experiments.outputs import draw_if_possible, drawing
from recon_cli.experiments.variants import run_grid
from recon_cli.pipeline import execute, plan
from recon_cli.pipeline.execute import Job
from recon_cli.stages import stage
from recon_cli.train.fit import Report, Task, fit
from recon_cli.train.importance import Importance
from recon_cli.train.prune_run import Course, course_of
from recon_cli.train.pruning import Advance, remaining, removals, remove, scored, survivors
from recon_cli.train.state import TrainState
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import disk_errors

RESULT, PICTURE = "sweep.json", "sweep.svg"
NONE = "none"  # stands for no score where nothing is removed
_WARM_STEPS = 10  # before anything is timed: the first steps load kernels and make buffers


@dataclass(frozen=True)
class SweepTrial:
    """One way to prune the model and what came of it."""

    score: str  # its name; `none` for the controls
    # Fraction that was removed; for a control with equal seconds that of the trial whose seconds it
    # takes, None for the one with equal steps.
    ratio: float | None
    gaussians: int  # that are left
    steps: int  # of recovery
    seconds: float  # of recovery and scoring
    removed: MeanScore | None  # right after the last removal; None where nothing was removed
    recovered: MeanScore  # at the end


def run_sweep(job: Job, config: PruneConfig, ratios: Sequence[float]) -> str:
    """Writes sweep.json and sweep.svg into the workspace and returns the table.

    The options are those of `recon prune`, but for score, ratio and limits; each ratio is the
    fraction to remove, in (0, 1).

    Raises:
        StageError: there is no fresh model.
        TrainingError: there are no validation views.
        WorkspaceError: the workspace is in use or cannot be written.
    """
    root, row = job.workspace.root, stage("prune")
    plan.plan(job.inspect(), "prune")
    with disk_errors(root, "sweeping"), job.workspace.writing("prune --sweep"):
        context = execute.stage_context(job, row, lambda _done, _total: None)
        inputs = StageInputs({name: job.workspace.folder(name) for name in row.needs})
        course = course_of(config, inputs, root, context)
        views, steps = len(course.task.validation), course.until - course.first
        if not views:
            raise TrainingError(
                "A sweep is scored on validation views, but the run has none.",
                hint="Run `recon train --validation 0.05` first.")
        state = course.start()
        before = score_validation(state, course.task)
        with job.progress.bar("sweep", count_trials(ratios), unit="run") as bar:
            trials = sweep(course, ratios, on_trial=bar.advance)
        of_train = job.workspace.manifest("train")
        atomic.write_json(root / RESULT, {
            "of_train": of_train.digest if of_train else None, "validation_views": views,
            "at": config.at, "rounds": course.rounds, "recovery_steps": steps,
            "equal_seconds_of": config.score, "before": dataclasses.asdict(before),
            "trials": [dataclasses.asdict(trial) for trial in trials]})
        draw_if_possible(lambda path: draw(trials, before.psnr_db, path), root / PICTURE)
    return (
        f"PSNR in dB and SSIM on {views} validation views, right after the last removal and after "
        f"{steps} steps of recovery with up to {course.rounds} rounds. Before: "
        f"{len(state.splats):,} Gaussians, {before.psnr_db:.2f}, {before.ssim:.4f}.\n\n"
        f"{table(trials, config.score)}")


def count_trials(ratios: Sequence[float]) -> int:
    """Returns how many trials a sweep makes."""
    return 1 + len(ratios) * (len(PRUNE_SCORES) + 1)


def sweep(
    course: Course, ratios: Sequence[float], *, on_trial: Callable[[], None]
) -> list[SweepTrial]:
    """Returns the control with equal steps, then for every ratio all scores and their control.

    Equal seconds are those of the score that the options name.
    """
    steps = course.until - course.first
    _train_on(course, None, min(_WARM_STEPS, steps))
    control = _train_on(course, None, steps)
    on_trial()
    of_options = control

    def measure(score: str, ratio: float) -> SweepTrial:
        nonlocal of_options
        if score == NONE:
            share = of_options.seconds / max(control.seconds, 1e-9)
            trial = _train_on(course, ratio, max(1, round(share * steps)))
        else:
            trial = _prune(course, score, ratio)
            of_options = trial if score == course.config.score else of_options
        on_trial()
        return trial

    by_score = run_grid({score: score for score in (*PRUNE_SCORES, NONE)}, ratios, measure)
    return [control, *(trial for by_ratio in zip(*by_score.values(), strict=True)
                       for trial in by_ratio)]


def _train_on(course: Course, ratio: float | None, steps: int) -> SweepTrial:
    """Trains on without removing anything."""
    state, begin = course.start(), time.perf_counter()
    task = course.recovering(course.first, course.first + steps)
    advancing(task)(state, course.first + steps, None)
    seconds = time.perf_counter() - begin
    return SweepTrial(
        NONE, ratio, len(state.splats), steps, seconds, None, score_validation(state, task))


def _prune(course: Course, name: str, ratio: float) -> SweepTrial:
    """Prunes by one score to one ratio."""
    state, first, until = course.start(), course.first, course.until
    task, n = course.recovering(first, until), len(state.splats)
    removed, seconds = None, 0.0
    rounds = removals(n, remaining(n, ratio), course.rounds, until - first)
    for removal in rounds:
        begin = time.perf_counter()
        score = scored(
            state, task, first + removal.after, name=name, beta=course.config.beta,
            advance=advancing(task))
        remove(state, survivors(score, removal.count))
        seconds += time.perf_counter() - begin
    if rounds:
        removed = score_validation(state, task)
    begin = time.perf_counter()
    advancing(task)(state, until, None)
    seconds += time.perf_counter() - begin
    return SweepTrial(name, ratio, len(state.splats), until - first, seconds, removed,
                      score_validation(state, task))


def advancing(task: Task) -> Advance:
    """Returns the function that trains; validation views are not looked at meanwhile."""
    blind = dataclasses.replace(task, validation=[])

    def ignore(_: TrainState | Report) -> None:
        """Keeps nothing."""

    def advance(state: TrainState, until: int, importance: Importance | None) -> None:
        fit(state, blind, until, on_step=ignore, on_report=ignore, importance=importance)

    return advance


def score_validation(state: TrainState, task: Task) -> MeanScore:
    """Returns the scores of a model on the validation views, of masked ones where they count."""
    degree = task.schedule.sh_degree(max(1, state.iteration))
    return mean_score(state.splats, task.validation, degree, task.backend)


def table(trials: Sequence[SweepTrial], score: str) -> str:
    """Returns the trials as a table; the controls are called by what is equal in them."""
    def cells(quality: MeanScore | None) -> tuple[str, str]:
        return ("-", "-") if quality is None else (
            f"{quality.psnr_db:.2f}", f"{quality.ssim:.4f}")

    rows = []
    for trial in trials:
        name, ratio = trial.score, "-" if trial.removed is None else f"{trial.ratio:.0%}"
        if trial.removed is None:
            name = "(no prune, equal steps)" if trial.ratio is None else (
                f"(no prune, seconds of {score} {trial.ratio:g})")
        rows.append((name, ratio, f"{trial.gaussians:,}", f"{trial.steps}", f"{trial.seconds:.1f}",
                     *cells(trial.removed), *cells(trial.recovered)))
    return Table(("score", "removed", "Gaussians", "steps", "seconds", "PSNR removed",
                  "SSIM removed", "PSNR recovered", "SSIM recovered"), tuple(rows)).text()


def draw(trials: Sequence[SweepTrial], before_db: float, path: Path) -> None:
    """Draws PSNR against the fraction removed, a line a score and the controls, into a .svg."""
    with drawing(path, 8, 5.5) as figure:
        axes = figure.subplots()
        for name in (*PRUNE_SCORES, NONE):
            line = [(trial.ratio, trial.recovered.psnr_db) for trial in trials
                    if trial.score == name and trial.ratio is not None]
            style = {"color": "0.3", "linestyle": "--", "label": "no prune, equal seconds"}
            axes.plot(*zip(*line, strict=True), **style if name == NONE else {
                "marker": "o", "markersize": 4, "label": name})
        axes.axhline(
            trials[0].recovered.psnr_db, color="0.3", label="no prune, equal steps")
        axes.axhline(before_db, color="0.7", linestyle=":", label="before")
        axes.set(xlabel="share of the Gaussians that was removed",
                 ylabel="PSNR on the validation views after recovery, dB")
        axes.legend(fontsize=8)
        axes.grid(color="0.92")
