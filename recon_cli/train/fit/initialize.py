"""The state before the first step, with the parts of the model that the options name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon_cli.config.stages import MIN_GAUSSIANS
from recon_cli.errors import TrainingError, format_count, name_command
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.splats import SH_C0, TERMS, Splats, joined
from recon_cli.train.fit.state import TrainState, load_state, new_state
from recon_cli.train.fit.task import Task
from recon_cli.train.parts.part import Start
from recon_cli.train.parts.photometry import Photometry
from recon_cli.train.parts.table import PARTS

_OPACITY = 0.1  # initial opacity of the reference implementation
_NEIGHBOURS = MIN_GAUSSIANS - 1
_MIN_SCALE = 1e-7  # world units; coincident points would otherwise start at scale 0


def splats_from_points(
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    *,
    most: int,
    seed: int,
    sh_degree: int,
) -> Splats:
    """Returns one round Gaussian a point, as large as the mean distance to its 3 nearest.

    (Kerbl et al. 2023, section 5.2.) Of more than `most` points a seeded draw is taken. Colours
    have room for spherical harmonics up to `sh_degree`.

    Raises:
        TrainingError: there are fewer than 4 points.
    """
    if len(points) <= _NEIGHBOURS:
        raise TrainingError(
            f"The reconstruction has {format_count(len(points), 'point')}; at least 4 are needed "
            "to start.",
            hint=f"Film slower with more overlap, then run {name_command('ingest')} again.")
    if len(points) > most:
        chosen = np.sort(np.random.default_rng(seed).permutation(len(points))[:most])
        points, colors = points[chosen], colors[chosen]
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    scales = np.maximum(distances[:, 1:].mean(axis=1), _MIN_SCALE)
    n = len(points)
    return Splats(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.tensor(np.log(scales), dtype=torch.float32)[:, None].repeat(1, 3),
        logit_opacities=torch.logit(torch.full((n,), _OPACITY)),
        sh_dc=(torch.tensor(colors, dtype=torch.float32) / 255 - 0.5) / SH_C0,
        sh_rest=torch.zeros(n, TERMS[sh_degree], 3))


def first_state(
    task: Task,
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    *,
    most: int,
) -> TrainState:
    """Returns the first state of a run: Gaussians at `most` points, and what parts add to them."""
    config = task.schedule.config
    start = Start(task, len(points), points, colors)
    for part in PARTS:
        if part.attach and part.is_on(config):
            part.attach(start)
    # added Gaussians do not take the place of sparse points as long as there is room to grow
    most = max(most, min(most + len(start.points) - start.sparse, config.max_gaussians // 2))
    grey = task.schedule.recipe.backdrop
    centers = np.stack([view.camera.center for view in task.train])
    splats = dataclasses.replace(
        _first_splats(start, most=most),
        backdrop=Backdrop.behind(grey, centers) if grey else None)
    return new_state(
        splats.map(lambda tensor: tensor.to(task.device)), config, task.means_unit,
        backend=task.backend, photometry=new_photometry(task, points))


def _first_splats(start: Start, *, most: int) -> Splats:
    """Returns the Gaussians before the first step: at the points, and others that parts add."""
    config = start.task.schedule.config
    others = [splats for splats in start.splats if len(splats)]
    at_points = splats_from_points(
        start.points, start.colors,
        most=max(most // 2, min(most, config.max_gaussians - sum(map(len, others)))),
        seed=config.seed, sh_degree=config.sh_degree)
    return joined([at_points, *others])[0] if others else at_points


def restore_state(path: Path, task: Task) -> TrainState:
    """Returns the state of a run from its checkpoint.

    Raises:
        FormatError: the file is truncated or of another version.
        TrainingError: it holds values that are not finite.
    """
    return load_state(
        path, task.schedule.config, task.means_unit, task.device, backend=task.backend,
        photometry=new_photometry(task))


def begin_state(splats: Splats, task: Task) -> TrainState:
    """Returns the state before the first step of a run that begins with these Gaussians."""
    return new_state(
        splats.map(lambda tensor: tensor.to(task.device)), task.schedule.config, task.means_unit,
        backend=task.backend, photometry=new_photometry(task))


def make_finished_state(splats: Splats, task: Task) -> TrainState:
    """Returns the state of a run that ended with these Gaussians, trained elsewhere."""
    state = new_state(
        splats.map(lambda tensor: tensor.to(task.device)), task.schedule.config, task.means_unit,
        backend=task.backend)
    state.iteration = task.schedule.config.iterations
    state.skipped_phase = 0, state.iteration
    return state


def new_photometry(
    task: Task, points: NDArray[np.float64] | None = None
) -> Photometry | None:
    """Returns the photometry of the training images before any step; None unless any is fitted.

    It starts with what `points` [P, 3] show; without them with no gain or vignette.
    """
    fitted = [part.fit(task, points) for part in PARTS
              if part.fit and part.is_on(task.schedule.config)]
    return Photometry(fitted) if fitted else None
