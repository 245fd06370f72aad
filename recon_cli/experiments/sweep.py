"""`recon prune --sweep`: quality after pruning by every score to every ratio, with controls.

One control removes at random. The others remove nothing: one takes as many steps, the others as
many seconds. sweep.json and sweep.svg lie beside the stages, so that no stage becomes stale.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from recon_cli.config.stages import PRUNE_SCORES, PruneConfig
from recon_cli.context import StageInputs
from recon_cli.errors import TrainingError
from recon_cli.evaluation.reference_views import mean_score
from recon_cli.evaluation.scores import MeanScore, Sweep, SweepTrial, Table
from recon_cli.experiments.outputs import Result, drawing
from recon_cli.experiments.runner import run_grid
from recon_cli.pipeline import execute, plan
from recon_cli.pipeline.execute import Job
from recon_cli.stages import stage
from recon_cli.train.fit import fit
from recon_cli.train.importance import RANDOM, Importance
from recon_cli.train.prune_loop import PruneRun, prune_loop, remaining
from recon_cli.train.prune_run import PruneSource, load_prune_source
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task
from recon_cli.workspace.layout import disk_errors

SCORES = (*PRUNE_SCORES, RANDOM)
_WARM_STEPS = 10  # before anything is timed: the first steps load kernels and make buffers


def run_sweep(job: Job, config: PruneConfig, ratios: Sequence[float]) -> Result:
    """Writes sweep.json and sweep.svg into the workspace and returns the result.

    The options are those of `recon prune`, except for score, ratio and limits; each ratio is the
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
        source = load_prune_source(config, inputs, context)
        views, steps = len(source.task.validation), source.until - source.first
        if not views:
            raise TrainingError(
                "A sweep is scored on validation views, but the run has none.",
                hint="Run `recon train --validation 0.05` first.")
        state = source.begin()
        before = _score_validation(state, source.task)
        with job.progress.bar("sweep", count_trials(ratios), unit="run") as bar:
            trials = sweep(source, ratios, on_trial=bar.advance)
        train = job.workspace.manifest("train")
        found = Sweep(
            of_train=train.digest if train else None, validation_views=views, at=config.at,
            rounds=source.rounds, recovery_steps=steps, equal_seconds_of=config.score,
            before=before, trials=tuple(trials))
        result = Result(
            found.to_json(),
            f"PSNR in dB and SSIM on {views} validation views, right after the last removal and "
            f"after {steps} steps of recovery with up to {source.rounds} rounds. Before: "
            f"{len(state.splats):,} Gaussians, {before.psnr_db:.2f}, {before.ssim:.4f}.",
            [table(trials, config.score)], draw=lambda path: draw(trials, before.psnr_db, path))
        result.save(root, "sweep")
    return result


def count_trials(ratios: Sequence[float]) -> int:
    """Returns how many trials a sweep makes."""
    return 1 + len(ratios) * (len(SCORES) + 1)


def sweep(
    source: PruneSource, ratios: Sequence[float], *, on_trial: Callable[[], None]
) -> list[SweepTrial]:
    """Returns the control of equal steps, then for every ratio all scores and their control."""
    steps = source.until - source.first
    _run_trial(source, Sweep.CONTROL, None, min(_WARM_STEPS, steps))
    control = configured = _run_trial(source, Sweep.CONTROL, None, steps)
    on_trial()

    def measure(score: str, ratio: float) -> SweepTrial:
        nonlocal configured
        if score == Sweep.CONTROL:
            share = configured.seconds / max(control.seconds, 1e-9)
            trial = _run_trial(source, score, ratio, max(1, round(share * steps)))
        else:
            trial = _run_trial(source, score, ratio, steps)
            configured = trial if score == source.config.score else configured
        on_trial()
        return trial

    by_score = run_grid({score: score for score in (*SCORES, Sweep.CONTROL)}, ratios, measure)
    return [control, *(trial for by_ratio in zip(*by_score.values(), strict=True)
                       for trial in by_ratio)]


def _run_trial(source: PruneSource, score: str, ratio: float | None, steps: int) -> SweepTrial:
    """Prunes by a score to a ratio and recovers; a control only trains on."""
    state, first = source.begin(), source.first
    run = _SweepRun(state, source.recovery(first, first + steps), first, first + steps,
                    rounds=0 if score == Sweep.CONTROL else source.rounds, score=score,
                    beta=source.config.beta)
    if score == Sweep.CONTROL or ratio is None:
        return run.trial(score, ratio, len(state.splats))
    return run.trial(score, ratio, remaining(len(state.splats), ratio))


class _SweepRun(PruneRun):
    """Trains without validation, and scores the model off the clock."""

    _removed: MeanScore | None = None
    _scoring_seconds = 0.0

    def trial(self, name: str, ratio: float | None, target: int) -> SweepTrial:
        """Prunes the model to `target` Gaussians and returns its scores."""
        self._target, begin = target, time.perf_counter()
        prune_loop(self, target)
        seconds = time.perf_counter() - begin - self._scoring_seconds
        return SweepTrial(
            name, ratio, len(self.state.splats), self.until - self.first, seconds, self._removed,
            _score_validation(self.state, self.task))

    def advance(self, until: int, importance: Importance | None = None) -> None:
        """Trains up to a step."""
        fit(self.state, dataclasses.replace(self.task, validation=[]), until, (), importance)

    def remove(self, score: Tensor, count: int) -> None:
        """Removes all but `count` Gaussians and scores the rest if no removal follows."""
        super().remove(score, count)
        if count == self._target:
            begin = time.perf_counter()
            self._removed = _score_validation(self.state, self.task)
            self._scoring_seconds = time.perf_counter() - begin


def _score_validation(state: TrainState, task: Task) -> MeanScore:
    """Returns the scores of a model on the validation views."""
    degree = task.schedule.sh_degree(max(1, state.iteration))
    return mean_score(state.splats, task.validation, degree, task.backend)


def table(trials: Sequence[SweepTrial], score: str) -> Table:
    """Returns the trials as a table; a control is named by the quantity that equals theirs."""
    def cells(scores: MeanScore | None) -> tuple[str, str]:
        return ("-", "-") if scores is None else (f"{scores.psnr_db:.2f}", f"{scores.ssim:.4f}")

    def name(trial: SweepTrial) -> tuple[str, str]:
        if trial.removed is not None:
            return trial.score, f"{trial.ratio:.0%}"
        if trial.ratio is None:
            return "(no prune, equal steps)", "-"
        return f"(no prune, seconds of {score} {trial.ratio:g})", "-"

    rows = [(*name(trial), f"{trial.gaussians:,}", f"{trial.steps}", f"{trial.seconds:.1f}",
             *cells(trial.removed), *cells(trial.recovered)) for trial in trials]
    return Table(("score", "removed", "Gaussians", "steps", "seconds", "PSNR removed",
                  "SSIM removed", "PSNR recovered", "SSIM recovered"), rows)


def draw(trials: Sequence[SweepTrial], before_db: float, path: Path) -> None:
    """Draws PSNR against the fraction removed into a .svg: a line a score, and the controls."""
    with drawing(path, 8, 5.5) as figure:
        axes = figure.subplots()
        for name in (*SCORES, Sweep.CONTROL):
            line = [(trial.ratio, trial.recovered.psnr_db) for trial in trials
                    if trial.score == name and trial.ratio is not None]
            style = {"color": "0.3", "linestyle": "--", "label": "no prune, equal seconds"}
            axes.plot(*zip(*line, strict=True), **style if name == Sweep.CONTROL else {
                "marker": "o", "markersize": 4, "label": name})
        axes.axhline(trials[0].recovered.psnr_db, color="0.3", label="no prune, equal steps")
        axes.axhline(before_db, color="0.7", linestyle=":", label="before")
        axes.set(xlabel="fraction of the Gaussians that was removed",
                 ylabel="PSNR on the validation views after recovery, dB")
        axes.legend(fontsize=8)
        axes.grid(color="0.92")
