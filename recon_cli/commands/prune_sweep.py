"""`recon prune --sweep`: runs the sweep of a workspace; no result of a stage is touched.

sweep.json and sweep.svg go into the workspace, beside the stages, so that nothing turns stale.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from recon_cli.config.stages import PruneConfig
from recon_cli.context import StageInputs
from recon_cli.errors import TrainingError
from recon_cli.evaluation.tables import Table
from recon_cli.pipeline import execute, plan
from recon_cli.pipeline.execute import Job
from recon_cli.stages import stage
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import disk_errors

if TYPE_CHECKING:
    from recon_cli.experiments.sweep import Trial
    from recon_cli.train.prune_run import Course

RESULT = "sweep.json"
PICTURE = "sweep.svg"

logger = logging.getLogger("recon")


def sweep(job: Job, config: PruneConfig, ratios: Sequence[float]) -> str:
    """Writes sweep.json and sweep.svg into the workspace and returns the table.

    Args:
        job: whose workspace holds a trained model.
        config: the options that `recon prune` would run with; score, ratio and limits are swept.
        ratios: shares that are removed, each in (0, 1).

    Raises:
        StageError: there is no fresh model.
        TrainingError: there are no validation views.
        WorkspaceError: the workspace is in use or cannot be written.
    """
    # torch is slow to import; --help does not wait for it
    from recon_cli.experiments import sweep as measure
    from recon_cli.train.prune_run import course_of

    root, row = job.workspace.root, stage("prune")
    plan.plan(job.inspect(), "prune")
    with disk_errors(root, "sweeping"), job.workspace.writing("prune --sweep"):
        context = execute.context_for(job, row, lambda _done, _total: None)
        inputs = StageInputs({name: job.workspace.folder(name) for name in row.needs})
        course = course_of(config, inputs, root, context)
        if not course.task.validation:
            raise TrainingError(
                "A sweep is scored on validation views, but the run has none.",
                hint="Run `recon train --validation 0.05` first.")
        start = measure.quality(course.start(), course.task)
        found: list[Trial] = []
        with job.progress.bar("sweep", measure.trials(ratios), unit="run") as bar:
            for trial in measure.sweep(course, ratios):
                found.append(trial)
                bar.advance()
        of_train = job.workspace.manifest("train")
        atomic.write_json(root / RESULT, {
            "of_train": of_train.digest if of_train else None,
            "validation_views": len(course.task.validation), "at": config.at,
            "rounds": course.rounds, "recovery_steps": course.until - course.first,
            "equal_seconds_of": config.score, "before": dataclasses.asdict(start),
            "trials": [dataclasses.asdict(trial) for trial in found]})
        _draw(found, start.psnr_db, root / PICTURE)
    return f"{_heading(course, start.psnr_db, start.ssim)}\n\n{table(found, config.score)}"


def _draw(found: Sequence[Trial], before: float, path: Path) -> None:
    """Draws the picture, or says what is missing for it."""
    if importlib.util.find_spec("matplotlib") is None:
        logger.warning("%s is not drawn: matplotlib is not installed; "
                       "pip install 'recon-cli[plot]'", path.name)
        return
    from recon_cli.experiments.sweep import draw

    draw(found, before, path)


def _heading(course: Course, psnr_db: float, ssim: float) -> str:
    gaussians = len(course.start().splats)
    return (
        f"PSNR in dB and SSIM on {len(course.task.validation)} validation views, right after the "
        f"last removal and after {course.until - course.first} steps of recovery with up to "
        f"{course.rounds} rounds. Before: {gaussians:,} Gaussians, {psnr_db:.2f}, {ssim:.4f}.")


def table(found: Sequence[Trial], score: str) -> str:
    """Returns the trials as a table; the controls are called by what is equal in them."""
    rows = [["score", "removed", "Gaussians", "steps", "seconds", "PSNR removed", "SSIM removed",
             "PSNR recovered", "SSIM recovered"]]
    for one in found:
        name = one.score
        if one.removed is None:
            name = "(no prune, equal steps)" if one.ratio is None else (
                f"(no prune, seconds of {score} {one.ratio:g})")
        removed = ["-", "-"] if one.removed is None else [
            f"{one.removed.psnr_db:.2f}", f"{one.removed.ssim:.4f}"]
        share = "-" if one.removed is None else f"{one.ratio:.0%}"
        rows.append([name, share, f"{one.gaussians:,}", f"{one.steps}", f"{one.seconds:.1f}",
                     *removed, f"{one.recovered.psnr_db:.2f}", f"{one.recovered.ssim:.4f}"])
    return Table(tuple(rows[0]), tuple(map(tuple, rows[1:]))).text()
