"""train: Gaussians from cameras and points, by the reference recipe.

Leaves splats.ply, the state at the middle of the run (where pruning branches off) and at its end,
and log.jsonl with loss, validation PSNR, count and seconds every hundred steps.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch

from recon_cli.config import TrainConfig
from recon_cli.io.ply import write_ply
from recon_cli.stages.context import StageContext, StageInputs, Summary
from recon_cli.stages.fitting import (
    CHECKPOINT,
    LOG,
    load_scene,
    load_task,
    run_fit,
    size_summary,
    write_config,
)
from recon_cli.train.initialize import splats_from_points
from recon_cli.train.state import load_state, new_state, save_state
from recon_cli.train.step import fuses


def run(config: TrainConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Fits Gaussians to the training views and returns how far it came."""
    scene = load_scene(inputs, validation=config.validation)
    task = load_task(scene, config, ctx)
    checkpoint = out / CHECKPOINT
    if checkpoint.exists():
        state = load_state(
            checkpoint, config, task.extent, task.device, fused=fuses(task.backend))
    else:
        first = splats_from_points(
            scene.points, scene.colors, most=config.max_gaussians, seed=config.seed,
            sh_degree=config.sh_degree)
        state = new_state(
            first.map(lambda tensor: tensor.to(task.device)), config, task.extent,
            fused=fuses(task.backend))
    run_fit(
        state, task, config.iterations, out, ctx, label="train",
        keep={task.schedule.mid: "mid.safetensors"})
    save_state(out / "final.safetensors", state)
    write_config(out, config)
    write_ply(out / "splats.ply", state.splats)
    checkpoint.unlink(missing_ok=True)
    last = json.loads((out / LOG).read_text(encoding="utf-8").splitlines()[-1])
    return {
        "iterations": state.iteration, "gaussians": len(state.splats),
        "initial_gaussians": min(len(scene.points), config.max_gaussians),
        "training_views": len(task.train), "validation_views": len(task.validation),
        **size_summary([view.camera for view in task.train]),
        "validation_psnr_db": last["validation_psnr_db"], "train_seconds": last["seconds"],
        "cuda_peak_bytes": torch.cuda.max_memory_allocated() if ctx.device == "cuda" else 0,
    }
