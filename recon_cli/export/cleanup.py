"""Removal of floaters, as the training views show them, and of islands.

There are three kinds of floaters. *Unseen*: no view blends it with more than a tiny weight
(RadSplat, Niemeyer et al. 2024, prunes by the same maximum). *In front*: at most two views see it,
and in each it is less than half way to the surface behind it: it was fitted to these views alone.
*Harmful*: without it the views would be rendered better. That is exact for each Gaussian alone,
since colour is affine in its alpha: with d = alpha T (c - B) its contribution to a pixel and e the
error there, removing it changes the squared error by sum ||d||^2 - 2 sum e d. The first sum is
`loo`; the second is the gradient of half the squared error by the logarithm of the opacity.
Gaussians that cover each other share their error, so only the worst are removed before the rest is
measured again.

Islands are small groups far from the scene, the largest group of touching Gaussians. Two touch if
their centres are within three of their standard deviations together, along the line between them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, name_command
from recon_cli.render import RenderOutput, render
from recon_cli.render.contract import ALPHA_MIN, SHOWN_WEIGHT
from recon_cli.render.depth_loss import LEAST_COVERAGE
from recon_cli.render.view_gradient import TensorCamera
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import EXTENT_SIGMAS, Splats
from recon_cli.scene.statistics import MIN_OBSERVATIONS
from recon_cli.scene.train_view import TrainView
from recon_cli.splats.values import HUGE, measure_distances, measure_extent

_NEIGHBOURS = 16  # compared with each; a surface around a Gaussian has about six
_APART = 0.05  # of the scene's radius: 12 cm in a room with a radius of 2.5 m
_OUTSIDE = 0.005  # of the Gaussians: a group is small, or lies beyond a side of the scene's box
# Measurements behind these constants: tests/bench/notes/scenes.md.
_IN_FRONT = 0.5  # of the depth of the surface behind
_HARM = 3e-4  # of the squared error of all views that it causes: .0013 dB
_FAINT = 0.1  # opacity; without views only such a large Gaussian counts as haze
_WORST = 0.2  # of the greatest harm: the threshold of a round
_ROUNDS = 12

logger = logging.getLogger("recon")


def drop_floaters(splats: Splats, views: Sequence[TrainView], ctx: StageContext) -> Splats:
    """Returns a scene without floaters, and logs how many of each kind are removed.

    The training views' cameras are in its world. ConfigError if nothing would be left.
    """
    on_device = splats.map(lambda tensor: tensor.to(ctx.device))
    with ctx.progress.bar("look for floaters", 3 * len(views), unit="view") as bar:
        floaters = find_floaters(on_device, views, backend=ctx.backend, on_view=bar.advance)
    logger.info(
        "floaters: %d Gaussians that no view shows, %d in front of the few views that show them, "
        "%d that make the views worse", int(floaters.unseen.sum()),
        int(floaters.in_front.sum()), int(floaters.harmful.sum()))
    return _drop(splats, floaters.all, "--drop-floaters")


def drop_islands(
    splats: Splats, room: tuple[list[float], float], views: Sequence[TrainView] | None,
    ctx: StageContext,
) -> Splats:
    """Returns a scene without small groups of Gaussians far from all others.

    `room` is its middle [3] and radius; `views` are the training views, None if there are none.
    """
    near = splats.within(*room)
    visible = None
    if views is not None:
        on_device = splats.map(lambda tensor: tensor.to(ctx.device))
        visible = count_sightings(on_device, views, backend=ctx.backend).cpu() > 0
    return _drop(splats, find_islands(splats, near, visible), "--drop-islands")


def drop_floaters_without_views(splats: Splats, room: tuple[list[float], float]) -> Splats:
    """Returns a scene without floaters, as far as they can be told without views, and logs them.

    These are Gaussians too faint to be drawn, haze (faint ones that are large for their distance
    from the middle of the room), and those in the room that touch no other. `room` is its middle
    [3] and radius. ConfigError if nothing would be left.
    """
    means, opacities = splats.means.detach().double(), splats.opacities.detach()
    invisible = opacities < ALPHA_MIN
    distances, bulk = measure_distances(means.cpu().numpy())
    away = torch.from_numpy(distances).to(means.device)
    large = splats.scales.detach().amax(dim=1) > HUGE * away.clamp_min(bulk)
    haze = (opacities < _FAINT) & large & ~invisible
    alone = torch.zeros_like(invisible)
    rows = torch.nonzero(splats.within(*room) & ~invisible)[:, 0]
    if len(rows) > _NEIGHBOURS:
        group = _find_groups(means[rows].cpu().numpy(), splats.select(rows))
        alone[rows] = torch.from_numpy(np.bincount(group)[group] == 1).to(rows.device)
    alone &= ~haze
    logger.info(
        "floaters: %d Gaussians that are too faint to be drawn, %d faint and large, %d that touch "
        "no other", int(invisible.sum()), int(haze.sum()), int(alone.sum()))
    return _drop(splats, invisible | haze | alone, "--drop-floaters")


def _drop(splats: Splats, removed: Tensor, option: str) -> Splats:
    remaining = ~removed.cpu()
    if not torch.any(remaining):
        raise ConfigError(
            f"{option} would remove all {len(splats):,} Gaussians.",
            hint=f"Check that the views show the scene: {name_command('render --views train')}.")
    return splats.select(remaining)


@dataclass(frozen=True, eq=False)
class Floaters:
    """Masks of the Gaussians of each kind, [N] bool; they are disjoint."""

    unseen: Tensor
    in_front: Tensor
    harmful: Tensor

    @property
    def all(self) -> Tensor:
        """Mask of all kinds, [N] bool."""
        return self.unseen | self.in_front | self.harmful


def find_floaters(
    splats: Splats, views: Sequence[TrainView], *, backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> Floaters:
    """Returns which Gaussians are floaters, by training views with cameras in their world.

    `on_view` is called after each rendered view.
    """
    none = torch.zeros(len(splats), dtype=torch.bool, device=splats.means.device)
    seen_by = count_sightings(splats, views, backend=backend, on_view=on_view)
    floaters = Floaters(
        seen_by == 0, _find_in_front(splats, seen_by, views, backend, on_view), none)
    rows = torch.nonzero(~floaters.all)[:, 0]
    harmful = none.clone()
    for number in range(1, _ROUNDS + 1):
        harm, error = measure_harm(splats.select(rows), views, backend=backend, on_view=on_view)
        worst = harm > max(_HARM * error, _WORST * float(harm.max()) if len(rows) else 0.0)
        if not worst.any() or worst.all():
            break
        logger.info("floaters, round %d: %d Gaussians make the training views worse", number,
                    int(worst.sum()))
        harmful[rows[worst]] = True
        rows = rows[~worst]
    return Floaters(floaters.unseen, floaters.in_front, harmful)


def measure_harm(
    splats: Splats, views: Sequence[TrainView], *, backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> tuple[Tensor, float]:
    """Returns by how much the squared error shrinks without each one, [N] float64, and the error.

    Pixels that a mask ignores have no error.
    """
    leaves = splats.map(lambda tensor: tensor.detach().requires_grad_(True))
    device = splats.means.device
    loo = torch.zeros(len(splats), dtype=torch.float64, device=device)
    total = 0.0
    for view in views:
        mask = view.counting(device)
        output = _render_scores(leaves, view.camera, backend, mask)
        difference = output.rgb - view.pixels(device)
        if mask is not None:
            difference = difference * mask[..., None]
        error = 0.5 * difference.square().sum()
        total += 2 * float(error.detach())
        if error.requires_grad:
            error.backward()  # type: ignore[no-untyped-call]
        loo += output.statistics.loo
        on_view()
    gradient = leaves.logit_opacities.grad
    if gradient is None:
        return torch.zeros_like(loo), total
    # d/d log o = (d/d logit) / (1 - o), for o' = o (1 - o)
    by_log = gradient.double() * (1 + torch.exp(splats.logit_opacities.detach().double()))
    return 2 * by_log - loo, total


def count_sightings(
    splats: Splats, views: Sequence[TrainView], *, backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> Tensor:
    """Returns how many views blend each Gaussian with a weight of 0.01 or more, [N] int64."""
    seen_by = torch.zeros(len(splats), dtype=torch.int64, device=splats.means.device)
    with torch.no_grad():
        for view in views:
            statistics = _render_scores(splats, view.camera, backend).statistics
            seen_by += statistics.blend_max >= SHOWN_WEIGHT
            on_view()
    return seen_by


def _render_scores(
    splats: Splats, camera: Camera, backend: str, mask: Tensor | None = None
) -> RenderOutput:
    background = torch.zeros(3, dtype=splats.means.dtype, device=splats.means.device)
    return render(
        splats, camera, background, splats.sh_degree, backend=backend, scores=True, mask=mask)


def _find_in_front(
    splats: Splats, seen_by: Tensor, views: Sequence[TrainView], backend: str,
    on_view: Callable[[], None],
) -> Tensor:
    """Returns which Gaussians are in front of the few views that see them, [N] bool."""
    few = (seen_by > 0) & (seen_by < MIN_OBSERVATIONS)
    in_front = few.clone()
    rest = splats.select(~few)
    if not few.any() or not len(rest):
        return torch.zeros_like(few)
    with torch.no_grad():
        for view in views:
            statistics = _render_scores(splats, view.camera, backend).statistics
            visible = few & (statistics.blend_max >= SHOWN_WEIGHT)
            if visible.any():
                behind = _render_scores(rest, view.camera, backend)
                in_front[visible] &= _is_before(splats.means[visible], view.camera, behind)
            on_view()
    return in_front


def _is_before(means: Tensor, camera: Camera, behind: RenderOutput) -> Tensor:
    """Returns which centres [K, 3] are far in front of a rendered surface, [K] bool."""
    pixels, z = TensorCamera.from_camera(camera, means).project(means)
    column, line = pixels.long().unbind(1)
    column, line = column.clamp(0, camera.width - 1), line.clamp(0, camera.height - 1)
    cover = behind.alpha[line, column]
    return (cover >= LEAST_COVERAGE) & (z * cover < _IN_FRONT * behind.depth[line, column])


def find_islands(splats: Splats, near: Tensor, visible: Tensor | None) -> Tensor:
    """Returns which Gaussians belong to islands, [N] bool.

    `near` [N] are those near enough to be islands, `visible` [N] those that a training view shows,
    None if unknown. Groups outside the box of the scene that a view shows, through a window, are
    not islands.
    """
    drawn = (near & (splats.opacities >= ALPHA_MIN)).cpu()
    rows = torch.nonzero(drawn)[:, 0]
    is_island = torch.zeros(len(splats), dtype=torch.bool)
    if len(rows) <= _NEIGHBOURS:
        return is_island.to(near.device)
    means = splats.means[rows.to(near.device)].detach().double().cpu().numpy()
    group = _find_groups(means, splats.select(rows.to(near.device)))
    counts = np.bincount(group)
    main = int(counts.argmax())
    far = _find_far_groups(means, group, main)
    small = counts <= max(1, int(_OUTSIDE * len(rows)))
    small[main] = False
    removed = small[group] & far[group]
    if visible is not None:
        low, high = np.quantile(means[group == main], (_OUTSIDE, 1 - _OUTSIDE), axis=0)
        outside = ((means < low) | (means > high)).any(axis=1)
        window = outside & visible.cpu().numpy()[rows.numpy()]
        removed &= ~np.isin(group, np.unique(group[window]))
    is_island[rows[torch.from_numpy(removed)]] = True
    return is_island.to(near.device)


def _find_groups(means: NDArray[np.float64], splats: Splats) -> NDArray[np.int64]:
    """Returns the index of the group of each Gaussian, [K]."""
    distance, other = cKDTree(means).query(means, k=_NEIGHBOURS + 1)
    scales = splats.scales.detach().double().cpu().numpy()
    quats = splats.quats.detach().double().cpu().numpy()
    quats[~quats.any(axis=1)] = [1, 0, 0, 0]
    rotation = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    sources, targets = [], []
    for rank in range(1, _NEIGHBOURS + 1):  # one at a time: all at once would take gigabytes
        neighbour, apart = other[:, rank], distance[:, rank]
        way = (means[neighbour] - means) / np.maximum(apart, 1e-12)[:, None]
        touch = np.flatnonzero(apart <= EXTENT_SIGMAS * (
            _deviations_along(scales, rotation, way)
            + _deviations_along(scales[neighbour], rotation[neighbour], way)))
        sources.append(touch)
        targets.append(neighbour[touch])
    source, target = np.concatenate(sources), np.concatenate(targets)
    edges = coo_matrix((np.ones(len(source), bool), (source, target)), shape=(len(means),) * 2)
    return np.asarray(connected_components(edges, directed=False)[1], np.int64)


def _deviations_along(
    scales: NDArray[np.float64], rotation: NDArray[np.float64], way: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the standard deviations [K] along unit vectors: sqrt(d^T Sigma d) = |S R^T d|."""
    return np.asarray(np.linalg.norm(scales * np.einsum("kij,ki->kj", rotation, way), axis=1))


def _find_far_groups(
    means: NDArray[np.float64], group: NDArray[np.int64], main: int
) -> NDArray[np.bool_]:
    """Returns for each group whether it lies completely apart from the main one."""
    scene = means[group == main]
    _, radius = measure_extent(scene)
    nearest = np.full(int(group.max()) + 1, np.inf)
    distance, _ = cKDTree(scene).query(means)
    np.minimum.at(nearest, group, distance)
    return np.asarray(nearest > _APART * radius)
