"""train: Gaussians from cameras and points, by a plan that is made first.

Leaves splats.ply, the state at the middle of the run (where pruning branches off) and at its end,
plan.json and config.json (what was decided before the first step), and log.jsonl with loss,
validation PSNR, count and seconds every hundred steps.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path

import torch

from recon_cli.atomic import read_json, write_json
from recon_cli.config import RunConfig, TrainConfig
from recon_cli.io.ply import write_ply
from recon_cli.scene.scene import Scene
from recon_cli.stages.context import StageContext, StageInputs, Summary
from recon_cli.stages.fitting import (
    CHECKPOINT,
    LOG,
    gaussians_that_fit,
    load_scene,
    load_task,
    read_config,
    run_fit,
    size_summary,
    write_config,
)
from recon_cli.train import plan
from recon_cli.train.cost import calibrate
from recon_cli.train.fit import Task
from recon_cli.train.initialize import splats_from_points
from recon_cli.train.plan import Facts, Plan
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState, load_state, new_state, save_state
from recon_cli.train.step import fuses

PLAN = "plan.json"

logger = logging.getLogger("recon")


def run(config: TrainConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Fits Gaussians to the training views and returns how far it came."""
    scene = load_scene(inputs, validation=config.validation)
    task = _planned_task(config, scene, out, ctx)
    state = _state(task, scene, out / CHECKPOINT)
    run_fit(
        state, task, task.schedule.config.iterations, out, ctx, label="train",
        keep={task.schedule.mid: "mid.safetensors"})
    save_state(out / "final.safetensors", state)
    write_ply(out / "splats.ply", state.splats)
    (out / CHECKPOINT).unlink(missing_ok=True)
    return _summary(state, task, out, ctx)


def _planned_task(
    config: TrainConfig, scene: Scene, out: Path, ctx: StageContext
) -> Task:
    """Returns the task of a run by its plan: a recorded one, or one that is made and recorded."""
    if (out / PLAN).exists():
        recorded = dataclasses.replace(
            read_config(out), checkpoint_every=config.checkpoint_every)
        return load_task(scene, recorded, ctx)
    first = plan.first_config(config)
    fit_memory = gaussians_that_fit(scene, first, ctx)
    task = load_task(scene, first, ctx)
    facts = Facts(plan.detail(task.train), len(task.train), len(scene.points), fit_memory)
    made = _plan(config, facts, task, scene, out)
    _tell(made, config, facts, ctx)
    run_config = made.config(config)
    write_config(out, run_config)
    write_json(out / PLAN, dataclasses.asdict(made))
    return _with(task, run_config)


def _plan(config: TrainConfig, facts: Facts, task: Task, scene: Scene, out: Path) -> Plan:
    """Returns a plan, by the time that steps are found to take."""
    seconds = plan.CALIBRATION_SECONDS
    if config.minutes is not None:
        seconds = plan.CALIBRATION_SHARE * 60 * config.minutes
    cost = calibrate(
        _with(task, plan.probe_config(config, facts)), scene.points, scene.colors,
        scratch=out / "calibration.safetensors", seconds=seconds)
    return plan.make_plan(config, facts, cost)


def _with(task: Task, config: RunConfig) -> Task:
    return dataclasses.replace(task, schedule=Schedule(config))


def _tell(made: Plan, config: TrainConfig, facts: Facts, ctx: StageContext) -> None:
    logger.info(
        "training takes about %.0f s: %s steps, up to %s Gaussians, images of up to %d pixels",
        made.seconds, f"{made.iterations:,}", f"{made.max_gaussians:,}", made.max_size)
    wanted = plan.wanted(facts, made.iterations)
    if config.max_gaussians is None and made.max_gaussians < wanted:
        ctx.notice(f"memory has room for {made.max_gaussians:,} Gaussians; {wanted:,} would suit "
                   "the images")
    if config.minutes is not None and made.seconds > 60 * config.minutes:
        ctx.notice(f"{config.minutes:g} minutes are too short: the smallest run of "
                   f"{made.iterations} steps takes about {made.seconds:.1f} s")


def _state(task: Task, scene: Scene, checkpoint: Path) -> TrainState:
    """Returns the state that a checkpoint holds, or the first one."""
    config, fused = task.schedule.config, fuses(task.backend)
    if checkpoint.exists():
        return load_state(checkpoint, config, task.extent, task.device, fused=fused)
    first = splats_from_points(
        scene.points, scene.colors, most=config.max_gaussians, seed=config.seed,
        sh_degree=config.sh_degree)
    return new_state(
        first.map(lambda tensor: tensor.to(task.device)), config, task.extent, fused=fused)


def _summary(state: TrainState, task: Task, out: Path, ctx: StageContext) -> Summary:
    config, made = task.schedule.config, read_json(out / PLAN)
    last = json.loads((out / LOG).read_text(encoding="utf-8").splitlines()[-1])
    return {
        "iterations": state.steps, "gaussians": len(state.splats),
        "initial_gaussians": state.first_count, "max_gaussians": config.max_gaussians,
        "max_size": config.max_size, "planned_iterations": config.iterations,
        "stopped_early_at": state.jump[0] if state.jump else None,
        "training_views": len(task.train), "validation_views": len(task.validation),
        **size_summary([view.camera for view in task.train]),
        "validation_psnr_db": last["validation_psnr_db"], "train_seconds": last["seconds"],
        "estimated_seconds": made["seconds"],
        "calibration_seconds": round(made["cost"]["seconds"], 3),
        "cuda_peak_bytes": torch.cuda.max_memory_allocated() if ctx.device == "cuda" else 0,
    }
