"""The views that a run trains on, from disk, and the options that it was started with."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, FormatError, TrainingError
from recon_cli.evaluation import reference_views
from recon_cli.render.contract import NEAR
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.train_view import TrainView
from recon_cli.train.memory import check_memory, refuse_few_views
from recon_cli.train.schedule import Schedule
from recon_cli.train.task import Task
from recon_cli.workspace.atomic import read_json, write_bytes


def load_task(scene: Scene, config: RunConfig, ctx: StageContext) -> Task:
    """Returns the training task at the training size, images in memory as uint8.

    Raises:
        TrainingError: fewer than two views are left to train on, or memory is short.
    """
    refuse_few_views(scene)
    _refuse_tiny_units(scene)
    check_memory(scene, config, ctx)
    train = load_views(scene.train, config, ctx)
    if len(train) < 2:
        raise TrainingError(
            f"The masks leave only {len(train)} views to train on; at least 2 are needed.",
            hint=reference_views.MASK_HINT)
    if ctx.device == "cuda":
        train = [view.page_locked() for view in train]
    error = None if scene.error_px is None else scene.error_px / scene.train[0].camera.fx
    return Task(
        train, load_views(scene.validation, config, ctx), Schedule(config), scene.extent,
        ctx.backend, torch.device(ctx.device), camera_error=error)


def _refuse_tiny_units(scene: Scene) -> None:
    """Raises TrainingError where half of the scene lies in front of the rasterizer's near plane."""
    if scene.nearness < NEAR:
        raise TrainingError(
            f"Half of the points are nearer than {scene.nearness:.2g} units to a camera, and what "
            f"is nearer than {NEAR:g} is not drawn: the units of this scene are too large.",
            hint="Give it a scale with `recon sfm --scale-between A B METRES`, or scale the poses "
            "of the data set.")


def load_views(views: Sequence[View], config: RunConfig, ctx: StageContext) -> list[TrainView]:
    """Returns the views at the training size, without those whose mask leaves next to nothing."""
    return [*reference_views.load_views(
        views, config.max_size, "not trained on", ctx, denoised=config.images == "denoised")]


def write_config(folder: Path, config: RunConfig) -> None:
    """Writes the options of a run beside its checkpoints."""
    write_bytes(folder / "config.json", json.dumps(config.hashed_fields(), indent=1).encode())


def read_config(folder: Path) -> RunConfig:
    """Returns the options that `write_config` wrote.

    Raises:
        FormatError: a version before this one wrote a value that is no longer known.
    """
    path = folder / "config.json"
    values = read_json(path)
    names = {item.name for item in dataclasses.fields(RunConfig)}
    try:
        return RunConfig(**{name: value for name, value in values.items() if name in names})
    except ConfigError as error:
        raise FormatError(
            f"{path} is of another version of recon: {error}",
            hint="Run `recon train --again`.") from error
