"""The scene of `bench_gpu.py`: the room of `recon bench`, seen from one place.

Steps start in the second half of a long run with the usual recipe, where images have their full
size and colours their full degree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import torch

from recon_cli.config.stages import RunConfig
from recon_cli.experiments.bench_scene import SceneSize, room
from recon_cli.render.triton import step as triton_step
from recon_cli.render.triton.step_status import StepReport
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.train import stepper
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState, new_state
from recon_cli.train.task import Task

_ITERATIONS = 30_000
GATHERING = 15_000  # step after a densification; the next one is 100 steps away
AFTER = 20_000  # no Gaussian is added any more
_GROWTH = 10  # the part by which the count may grow
_TURNS = 0.0, -0.05, 0.05, 0.1  # radians by which the views look aside
_STILL = {"means_rate": 0.0, "quats_rate": 0.0, "scales_rate": 0.0, "opacities_rate": 0.0,
          "sh_rate": 0.0}


def config_of(size: SceneSize, *, still: bool, batch_views: int = 1) -> RunConfig:
    """Returns the options of the steps.

    Args:
        size: the count.
        still: all rates are zero and the count stays, so that every step meets the same scene.
        batch_views: views of a step.
    """
    cap = size.gaussians if still else size.gaussians + size.gaussians // _GROWTH
    config = replace(RunConfig(), iterations=_ITERATIONS, max_gaussians=cap, sh_degree=3,
                     batch_views=batch_views)
    return replace(config, **_STILL) if still else config


def views_of(camera: Camera, device: str) -> list[TrainView]:
    """Returns photographs of noise from one place, with the camera turned a little."""
    views, rng = [], np.random.default_rng(0)
    for angle in _TURNS:
        turn, c, s = np.eye(4), np.cos(angle), np.sin(angle)
        turn[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        image = rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
        view = TrainView(replace(camera, viewmat=turn @ camera.viewmat), image)
        views.append(view.page_locked() if device == "cuda" else view)
    return views


def training(
    size: SceneSize, device: str, *, still: bool, batch_views: int = 1
) -> tuple[TrainState, Task]:
    """Returns a state and the task that it is in."""
    splats, camera = room(size.gaussians, size.width, size.height)
    config = config_of(size, still=still, batch_views=batch_views)
    state = new_state(
        splats.map(lambda tensor: tensor.to(device)), config, 1.0, backend="triton")
    state.first_count = size.gaussians
    return state, Task(
        views_of(camera, device), [], Schedule(config), 1.0, "triton", torch.device(device))


def stretch(
    state: TrainState, task: Task, start: int, steps: int
) -> Callable[[], None]:
    """Returns a function that takes the steps after `start`, as `recon train` does, and waits."""
    advance = stepper.choose_stepper(state, task, None, lambda now: now == start + steps)

    def take() -> None:
        state.iteration = start
        while state.iteration < start + steps:
            advance()

    return take


@contextmanager
def photometric(accounts: list[StepReport], **options: Any) -> Iterator[None]:
    """Lets steps that are made within the block have other options, and notes their accounts."""
    original = triton_step.PhotometricStep

    class Step(original):
        def __init__(self, device: torch.device) -> None:
            super().__init__(device, **options)

        def close(self) -> StepReport:
            accounts.append(super().close())
            return accounts[-1]

    with mock.patch.object(triton_step, "PhotometricStep", Step):
        yield


def without_graphs() -> triton_step.Graphs:
    """Returns a recorder that records nothing."""
    return triton_step.Graphs(None)
