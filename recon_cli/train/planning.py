"""What the train stage decides before its first step, and records: parts of the model, the plan.

A run that was interrupted goes on by the record, whatever a clock or a trial would say now.
"""

from __future__ import annotations

import dataclasses
import filecmp
import logging
from pathlib import Path
from typing import Any

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.context import StageContext
from recon_cli.scene.scene import Scene
from recon_cli.scene.train_view import TrainView
from recon_cli.train import plan
from recon_cli.train.cost import calibrate, with_exchange
from recon_cli.train.feature_trials import PARTS, Candidate, Needs, examine
from recon_cli.train.initialize import first_state, saved_state
from recon_cli.train.memory import gaussians_that_fit
from recon_cli.train.plan import Facts
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task
from recon_cli.train.train_data import (
    load_task,
    load_views,
    read_config,
    write_config,
)
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.summaries import TrainPlan

logger = logging.getLogger("recon")


def planned_task(config: TrainConfig, scene: Scene, out: Path, ctx: StageContext) -> Task:
    """Returns the task of a run by its plan: a recorded one, or one that is made and recorded."""
    if (out / TrainPlan.FILE).exists():
        recorded = dataclasses.replace(
            read_config(out), checkpoint_every=config.checkpoint_every)
        return load_task(scene, recorded, ctx)
    first = plan.first_config(config)
    fit_memory = gaussians_that_fit(scene, first, ctx)
    task = load_task(scene, first, ctx)
    needs = parts_needed(task, scene, ctx, harmonics=config.sh_degree is None)
    if needs.config.images == "denoised" and first.images != "denoised":
        task = load_task(scene, dataclasses.replace(first, images="denoised"), ctx)
    asked = dataclasses.replace(config, **model_parts(needs.config))
    facts = Facts(plan.detail(task.train), len(task.train), len(scene.points), fit_memory)
    made = _plan(asked, facts, task, scene, out, ctx, spent=needs.seconds)
    _tell(made, asked, facts, ctx)
    run_config = plan.run_config(asked, made)
    write_config(out, run_config)
    write_json(
        out / TrainPlan.FILE, dataclasses.replace(made, needs=needs.decisions).to_json())
    return _with(task, run_config)


def model_parts(config: RunConfig) -> dict[str, Any]:
    """Returns the parts of the model that trials decide on, by the names of their options."""
    return {name: getattr(config, name) for name in (*PARTS, "sh_degree")}


def parts_needed(
    task: Task, scene: Scene, ctx: StageContext, *, harmonics: bool = False
) -> Needs:
    """Returns which parts of the model the scene needs, and says so."""
    config = task.schedule.config

    def twins() -> tuple[list[TrainView], list[TrainView]]:
        denoised = dataclasses.replace(config, images="denoised")
        return load_views(scene.train, denoised, ctx), load_views(scene.validation, denoised, ctx)

    changed = config.images == "auto" and any(
        not filecmp.cmp(view.original, view.denoised, shallow=False) for view in scene.train)
    needs = examine(Candidate(
        task, scene.points, scene.colors, twins if changed else None, harmonics))
    for decision in needs.decisions:
        logger.info("%s: %s, %s", decision.name, "on" if decision.on else "off", decision.reason)
    return needs


def _plan(
    config: TrainConfig, facts: Facts, task: Task, scene: Scene, out: Path, ctx: StageContext, *,
    spent: float,
) -> TrainPlan:
    """Returns a plan, by the time that steps are found to take and that was spent already.

    Of several processes each step is timed with the views of one, and what they exchange.
    """
    seconds = plan.CALIBRATION_SECONDS
    if config.minutes is not None:
        seconds = plan.CALIBRATION_SHARE * 60 * config.minutes
    probe = dataclasses.replace(
        plan.probe_config(config, facts), batch_views=ctx.ranks.most_of(config.batch_views))
    cost = calibrate(
        _with(task, probe), scene.points, scene.colors,
        scratch=out / "calibration.safetensors", seconds=seconds)
    cost = with_exchange(cost, ctx.ranks, probe.max_gaussians, probe.sh_degree, task.device)
    return plan.make_plan(config, facts, cost, spent=spent)


def _with(task: Task, config: RunConfig) -> Task:
    return dataclasses.replace(task, schedule=Schedule(config))


def _tell(made: TrainPlan, config: TrainConfig, facts: Facts, ctx: StageContext) -> None:
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


def first_or_saved(task: Task, scene: Scene, checkpoint: Path) -> TrainState:
    """Returns the state that a checkpoint holds, or the first one."""
    if checkpoint.exists():
        return saved_state(checkpoint, task)
    most = plan.first_count(task.schedule.config, len(scene.points))
    return first_state(task, scene.points, scene.colors, most=most)
