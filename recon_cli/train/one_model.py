"""One model of a scene, from its plan to its .ply: of a whole scene, or of a block."""

from __future__ import annotations

from pathlib import Path

import torch

from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageContext
from recon_cli.io.views import size_summary
from recon_cli.scene.scene import Scene
from recon_cli.splats.ply import write_ply
from recon_cli.train.finished_model import FinishedModel
from recon_cli.train.fit.runner import CHECKPOINT, RunSegment, run_fit
from recon_cli.train.fit.state import TrainState, save_state
from recon_cli.train.fit.task import Task
from recon_cli.train.masks import EditedMasks, read_summary
from recon_cli.train.parts.photometry import write_photometry
from recon_cli.train.parts.table import model_parts
from recon_cli.train.plan import first_or_saved, plan_task
from recon_cli.workspace.atomic import delete
from recon_cli.workspace.records import ImportRecord
from recon_cli.workspace.summaries import LogRow, TrainPlan, TrainSummary


def fit_scene(
    config: TrainConfig, scene: Scene, out: Path, ctx: StageContext,
    model: FinishedModel | None = None, edited: EditedMasks | None = None,
) -> TrainSummary:
    """Fits Gaussians to the views of a scene and returns how far it came.

    `model` is the one that the run continues, None for a run that begins anew; `edited` are a
    user's masks of what moves.
    """
    task = plan_task(config, scene, out, ctx, model, edited)
    if model is not None and not (out / CHECKPOINT).exists():
        model.write_inherited_files(task.schedule, out, ctx)
    state = first_or_saved(task, scene, out / CHECKPOINT, model)
    plan = task.schedule
    until = plan.config.iterations
    if plan.config.compact_only:
        until = plan.mid
        ctx.notice(f"training ends after {until:,} of {plan.config.iterations:,} steps, where "
                   "pruning begins: without it the scene is unfinished")
    run_fit(state, task, until, RunSegment(
        out, "train", until, first=plan.first,
        keep={plan.mid: "mid.safetensors"}), ctx)
    save_state(out / "final.safetensors", state)
    write_ply(out / "splats.ply", state.splats)
    write_photometry(out, state.photometry)
    delete(out / CHECKPOINT)
    return _summarize(state, task, out, ctx, model.import_record if model else None)


def _summarize(
    state: TrainState, task: Task, out: Path, ctx: StageContext, import_record: ImportRecord | None
) -> TrainSummary:
    config, plan = task.schedule.config, TrainPlan.read(out)
    last = LogRow.read_all(out / LogRow.FILE)[-1]
    return TrainSummary(
        imported_from=import_record.file if import_record else None,
        continued_from_step=plan.continues_at or None,
        iterations=state.steps, gaussians=len(state.splats),
        initial_gaussians=state.first_count, max_gaussians=config.max_gaussians,
        max_size=config.max_size, planned_iterations=config.iterations,
        stopped_early_at=state.skipped_phase[0] if state.skipped_phase else None,
        training_views=len(task.train), validation_views=len(task.validation),
        **size_summary([view.camera for view in task.train]),
        validation_psnr_db=last.validation_psnr_db, train_seconds=last.seconds,
        parts=model_parts(config), skipped_steps=state.skipped, estimated_seconds=plan.seconds,
        calibration_seconds=round(plan.cost["seconds"], 3),
        cuda_peak_bytes=torch.cuda.max_memory_allocated() if ctx.device == "cuda" else 0,
        moving=read_summary(out),
        photometry=state.photometry.summarize() if state.photometry else None)
