"""The state before the first step, by what the options say is part of the model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.config import RunConfig
from recon_cli.scene.splats import Splats, joined
from recon_cli.train.exposure_start import estimated
from recon_cli.train.far import FarContent, far_content, splats_of
from recon_cli.train.fit import Task
from recon_cli.train.initialize import splats_from_points
from recon_cli.train.state import TrainState, new_state
from recon_cli.train.step import fuses


def first_state(
    task: Task,
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    *,
    most: int,
) -> TrainState:
    """Returns the state of a run before its first step; the same for the same task and points.

    Args:
        task: views and plan.
        points: sparse points in world units.
        colors: of them.
        most: Gaussians, those that lie far outside included unless they were more than half.
    """
    config = task.schedule.config
    far = far_content(task.train, points, task.extent) if config.far == "on" else None
    gains = estimated(task.train, points).log_gains if config.exposure == "on" else None
    splats = first_splats(config, points, colors, far, most=most)
    return new_state(
        splats.map(lambda tensor: tensor.to(task.device)), config, task.extent,
        fused=fuses(task.backend), images=len(task.train), log_gains=gains)


def first_splats(
    config: RunConfig, points: NDArray[np.float64], colors: NDArray[np.uint8],
    far: FarContent | None, *, most: int,
) -> Splats:
    """Returns the Gaussians before the first step: of the points, and of what lies far outside."""
    outside = 0 if far is None else len(far.positions)
    near = splats_from_points(
        points, colors, most=max(most // 2, most - outside), seed=config.seed,
        sh_degree=config.sh_degree)
    if far is None or len(far.positions) == 0:
        return near
    return joined([near, splats_of(far, near.sh_rest.shape[1])])[0]
