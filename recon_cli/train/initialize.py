"""The state before the first step, with the parts of the model that the options name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon_cli.config.stages import RunConfig
from recon_cli.deadline import Deadline
from recon_cli.errors import TrainingError, format_count
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.splats import SH_C0, TERMS, Splats, joined
from recon_cli.train.background import FarContent, far_content, splats_of
from recon_cli.train.exposure import Exposure, estimate_gains
from recon_cli.train.photometry import Photometry, Vignettes
from recon_cli.train.state import TrainState, load_state, new_state
from recon_cli.train.stereo_points import SurfacePoints
from recon_cli.train.task import Task
from recon_cli.train.vignette_evidence import find_vignettes

_OPACITY = 0.1  # initial opacity of the reference implementation
_NEIGHBOURS = 3
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
            hint="Film slower with more overlap, then run `recon ingest` again.")
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
    far: FarContent | None = None,
) -> TrainState:
    """Returns the first state of a run: Gaussians at `most` points, and the background `far`.

    What lies far outside is told by the sparse points alone: walls have its colour behind them too.
    Parts of the model may add points.
    """
    config = task.schedule.config
    if config.far != "on":
        far = None
    elif far is None:
        far = far_content(task.train, points, task.extent)
    photometry = new_photometry(task, points)
    sparse = len(points)
    surfaces = surfaces_of(task, sparse)
    points = np.concatenate([points, surfaces.points])
    colors = np.concatenate([colors, surfaces.colors])
    if far is not None:
        points = np.concatenate([points, far.gap_points])
        colors = np.concatenate([colors, far.gap_colors])
    # added Gaussians do not take the place of sparse points as long as there is room to grow
    most = max(most, min(most + len(points) - sparse, config.max_gaussians // 2))
    grey = task.schedule.recipe.backdrop
    centers = np.stack([view.camera.center for view in task.train])
    splats = dataclasses.replace(
        first_splats(config, points, colors, far, most=most),
        backdrop=Backdrop.behind(grey, centers) if grey else None)
    return new_state(
        splats.map(lambda tensor: tensor.to(task.device)), config, task.means_unit,
        backend=task.backend, photometry=photometry)


def surfaces_of(task: Task, sparse: int, deadline: Deadline | None = None) -> SurfacePoints:
    """Returns the points by stereo that a run begins with, besides those of structure from motion.

    They fill what `sparse` points leave of half of the cap: the rest goes where the error is.
    OutOfTime where a search for them would not end by the deadline.
    """
    config = task.schedule.config
    room = config.max_gaussians // 2 - sparse
    if config.stereo != "on" or task.stereo is None or room <= 0:
        return SurfacePoints.nothing()
    return task.stereo.search(deadline).at_most(room, config.seed)


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
    state.jump = 0, state.iteration
    return state


def new_photometry(
    task: Task, points: NDArray[np.float64] | None = None
) -> Photometry | None:
    """Returns the photometry of the training images before any step; None unless any is fitted.

    It starts with what `points` [P, 3] show; without them with no gain or vignette.
    """
    config, views = task.schedule.config, task.train
    gains = exponents = None
    if points is not None and config.exposure == "on":
        gains = estimate_gains(views, points).log_gains
    if points is not None and config.vignette == "on":
        exponents = find_vignettes(views, points).exponents
    return Photometry.from_parts(
        Exposure(len(views), start=gains) if config.exposure == "on" else None,
        Vignettes([view.camera for view in views], start=exponents)
        if config.vignette == "on" else None)


def first_splats(
    config: RunConfig, points: NDArray[np.float64], colors: NDArray[np.uint8],
    far: FarContent | None, *, most: int,
) -> Splats:
    """Returns the Gaussians before the first step: of the points, and of places far outside."""
    outside = 0 if far is None else len(far.positions)
    near = splats_from_points(
        points, colors, most=max(most // 2, min(most, config.max_gaussians - outside)),
        seed=config.seed, sh_degree=config.sh_degree)
    if far is None or len(far.positions) == 0:
        return near
    return joined([near, splats_of(far, near.sh_rest.shape[1])])[0]
