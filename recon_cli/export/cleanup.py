"""Small groups of Gaussians that hang together with nothing else.

Two Gaussians touch where their centres are no farther apart than three of their standard deviations
together, both along the line between them. The largest group that touches is the scene; small ones
far from it are islands.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from recon_cli.context import StageContext
from recon_cli.errors import ConfigError
from recon_cli.export.floaters import floaters, sightings
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView

logger = logging.getLogger("recon")


def without_floaters(splats: Splats, views: Sequence[TrainView], ctx: StageContext) -> Splats:
    """Returns a scene without what hangs in the air, and says how much of which kind goes.

    Args:
        splats: the scene, on the CPU.
        views: training views with cameras in its world.
        ctx: backend, device and progress.

    Raises:
        ConfigError: nothing would be left.
    """
    there = splats.map(lambda tensor: tensor.to(ctx.device))
    with ctx.progress.bar("look for floaters", 3 * len(views), unit="view") as bar:
        found = floaters(there, views, backend=ctx.backend, on_view=bar.advance)
    logger.info(
        "floaters: %d Gaussians that no view shows, %d in front of the few views that show them, "
        "%d that make the views worse", int(found.unseen.sum()), int(found.in_front.sum()),
        int(found.harmful.sum()))
    return _without(splats, found.all, "--drop-floaters")


def without_islands(
    splats: Splats, scene: Scene, similarity: Similarity, views: Sequence[TrainView] | None,
    ctx: StageContext,
) -> Splats:
    """Returns a scene without small groups of Gaussians far from all others.

    Args:
        splats: the scene, on the CPU.
        scene: says how far the room reaches, in the world of the training.
        similarity: from there to the world of `splats`.
        views: training views with cameras in that world; None where there are none.
        ctx: backend and device.
    """
    center = similarity.points(scene.center).tolist()
    near = splats.within(center, similarity.scale * scene.reach)
    seen = None
    if views is not None:
        there = splats.map(lambda tensor: tensor.to(ctx.device))
        seen = sightings(there, views, backend=ctx.backend).cpu() > 0
    return _without(splats, islands(splats, near, seen), "--drop-islands")


def _without(splats: Splats, goes: Tensor, option: str) -> Splats:
    stays = ~goes.cpu()
    if not torch.any(stays):
        raise ConfigError(
            f"{option} would leave nothing of {len(splats):,} Gaussians.",
            hint="Look whether the scene lies where the views look: `recon render --views train`.")
    return splats.select(stays)


_TOUCH = 3.0  # standard deviations
_NEIGHBOURS = 16  # looked at for each; a surface around a Gaussian has about six
_SMALL = 0.005  # of the Gaussians at most
_APART = 0.05  # of the scene's radius: 12 cm in a room with a radius of 2.5 m
_BULK = 0.9  # of the scene lies within its radius
_EDGE = 0.005  # of the scene lies beyond each side of its box
_VISIBLE = 1 / 255  # fainter ones are drawn nowhere, and touch nothing


def islands(splats: Splats, near: Tensor, seen: Tensor | None) -> Tensor:
    """Returns which Gaussians belong to islands, [N] bool.

    What lies outside the box of the scene and is seen by a view stays: that is what is seen through
    a window.

    Args:
        splats: N Gaussians.
        near: [N] bool, what is no view from a window for certain; the rest is left alone.
        seen: [N] bool, what a training view shows; None where nobody knows, and then what lies
            outside goes too.
    """
    drawn = (near & (splats.opacities >= _VISIBLE)).cpu()
    rows = torch.nonzero(drawn)[:, 0]
    found = torch.zeros(len(splats), dtype=torch.bool)
    if len(rows) <= _NEIGHBOURS:
        return found.to(near.device)
    means = splats.means[rows.to(near.device)].detach().double().cpu().numpy()
    group = _groups(means, splats.select(rows.to(near.device)))
    counts = np.bincount(group)
    main = int(counts.argmax())
    away = _apart(means, group, main)
    small = counts <= max(1, int(_SMALL * len(rows)))
    small[main] = False
    goes = small[group] & away[group]
    if seen is not None:
        low, high = np.quantile(means[group == main], (_EDGE, 1 - _EDGE), axis=0)
        outside = ((means < low) | (means > high)).any(axis=1)
        window = outside & seen.cpu().numpy()[rows.numpy()]
        goes &= ~np.isin(group, np.unique(group[window]))
    found[rows[torch.from_numpy(goes)]] = True
    return found.to(near.device)


def _groups(means: NDArray[np.float64], splats: Splats) -> NDArray[np.int64]:
    """Returns the number of the group that each Gaussian is in, [K]."""
    distance, other = cKDTree(means).query(means, k=_NEIGHBOURS + 1)
    scales = splats.scales.detach().double().cpu().numpy()
    turn = Rotation.from_quat(_wxyz(splats), scalar_first=True).as_matrix()
    ones, twos = [], []
    for near in range(1, _NEIGHBOURS + 1):  # one at a time: all at once would take gigabytes
        two, apart = other[:, near], distance[:, near]
        way = (means[two] - means) / np.maximum(apart, 1e-12)[:, None]
        touch = np.flatnonzero(apart <= _TOUCH * (
            _along(scales, turn, way) + _along(scales[two], turn[two], way)))
        ones.append(touch)
        twos.append(two[touch])
    one, two = np.concatenate(ones), np.concatenate(twos)
    edges = coo_matrix((np.ones(len(one), bool), (one, two)), shape=(len(means),) * 2)
    return np.asarray(connected_components(edges, directed=False)[1], np.int64)


def _along(
    scales: NDArray[np.float64], turn: NDArray[np.float64], way: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the standard deviations [K] along unit vectors: sqrt(d^T Sigma d) = |S R^T d|."""
    return np.asarray(np.linalg.norm(scales * np.einsum("kij,ki->kj", turn, way), axis=1))


def _wxyz(splats: Splats) -> NDArray[np.float64]:
    """Returns quaternions [K, 4], those of zeros as no rotation."""
    quats = splats.quats.detach().double().cpu().numpy()
    quats[~quats.any(axis=1)] = [1, 0, 0, 0]
    return np.asarray(quats)


def _apart(
    means: NDArray[np.float64], group: NDArray[np.int64], main: int
) -> NDArray[np.bool_]:
    """Returns for each group whether all of it lies far from the main one."""
    scene = means[group == main]
    middle = np.median(scene, axis=0)
    radius = np.quantile(np.linalg.norm(scene - middle, axis=1), _BULK)
    nearest = np.full(int(group.max()) + 1, np.inf)
    distance, _ = cKDTree(scene).query(means)
    np.minimum.at(nearest, group, distance)
    return np.asarray(nearest > _APART * radius)
