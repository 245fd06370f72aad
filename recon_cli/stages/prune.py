"""prune: removes the Gaussians that matter least to the training views, then lets the rest recover.

Branches off the finished run, or off its middle (what `recon train --prune` does): then the rest
of the run is trained without the pruned Gaussians, and both models have seen as many steps. The
unpruned model stays in train/, so that evaluation can set them side by side.
"""

from __future__ import annotations

from pathlib import Path

import torch

from recon_cli.config import PruneConfig, TrainConfig
from recon_cli.io.ply import write_ply
from recon_cli.scene.splats import Splats
from recon_cli.stages.context import StageContext, StageInputs, Summary
from recon_cli.stages.fitting import (
    CHECKPOINT,
    LOG,
    load_scene,
    load_task,
    read_config,
    run_fit,
    seconds_at,
)
from recon_cli.train.fit import Task, validation_psnr
from recon_cli.train.gathered import Gathered
from recon_cli.train.importance import kept_rows, significance
from recon_cli.train.state import TrainState, load_state
from recon_cli.train.step import fuses

_END_RECOVERY = 6  # the reference recovers for 5,000 steps after 30,000


def run(config: PruneConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Prunes, recovers and returns what was removed and what it cost."""
    train = inputs.folders["train"]
    train_config = read_config(train)
    scene = load_scene(inputs, validation=train_config.validation)
    task = load_task(scene, train_config, ctx)
    source = train / ("mid.safetensors" if config.at == "mid" else "final.safetensors")
    fused = fuses(task.backend)
    start = load_state(source, train_config, task.extent, task.device, fused=fused)
    until = _until(config, train_config, start.iteration)
    before, first = len(start.splats), start.iteration
    psnr_before = validation_psnr(start, task)
    if (out / CHECKPOINT).exists():
        state = load_state(
            out / CHECKPOINT, train_config, task.extent, task.device, fused=fused)
    else:
        state = _pruned(start, task, config)
    psnr_pruned = None if state.iteration > first else validation_psnr(state, task)
    run_fit(
        state, task, until, out, ctx, label="recover", first=first,
        earlier_seconds=seconds_at(train / LOG, first))
    write_ply(out / "splats.ply", state.splats)
    (out / CHECKPOINT).unlink(missing_ok=True)
    return {
        "at": config.at, "score": config.score, "ratio": config.ratio,
        "gaussians_before": before, "gaussians": len(state.splats),
        "recovery_steps": until - first, "iterations": state.iteration,
        "validation_psnr_db_before": psnr_before, "validation_psnr_db_pruned": psnr_pruned,
        "validation_psnr_db": validation_psnr(state, task),
        "train_seconds": seconds_at(out / LOG, until),
    }


def _until(config: PruneConfig, train: TrainConfig, first: int) -> int:
    """Returns the total number of steps at which recovery ends."""
    if config.recovery is not None:
        return first + config.recovery
    return train.iterations if config.at == "mid" else first + train.iterations // _END_RECOVERY


def _pruned(state: TrainState, task: Task, config: PruneConfig) -> TrainState:
    """Removes the lowest-ranked Gaussians of `state`, moments included."""
    degree = task.schedule.sh_degree(state.iteration)
    score = significance(
        config.score, state.splats, [view.camera for view in task.train], beta=config.beta,
        sh_degree=degree, backend=task.backend, generator=state.generator)
    rows = kept_rows(score, config.ratio)
    kept: Splats = state.splats.select(rows)
    state.optimizer.replace(kept, rows)
    state.gathered = Gathered.zeros(len(kept), torch.device(task.device))
    return state
