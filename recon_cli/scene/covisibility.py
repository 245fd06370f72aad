"""Which views see the same points, and where a scene is cut into blocks by that.

Views are cut where few points are seen from both sides, as at a door. A point belongs to the block
whose views see it most, and any other place to the block of the nearest point: so a cell ends at a
wall between two rooms, in any direction of that wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from recon_cli.scene.camera import Camera

_LEAST_SHARE = 0.2  # of the views of a part, on each side of a cut
_DENSE = 1500  # views up to which all eigenvectors are quicker than few
_NEIGHBOURS = 8  # points that outvote one seen from elsewhere
_ROUNDS = 3  # of voting
# Share of a view's points in a cell from which the view is trained on in its block
_SEES = 0.1
# Fields a side; depth of the points that count, over the nearest: at 1.1, views saw the next room's
# points through a wall of 30 cm, and blocks owned parts of each other's walls
_GRID, _BEHIND = 40, 1.02
_CONTEXT = 4  # one in so many of the points outside a cell is kept in its block


@dataclass(frozen=True, eq=False)
class Observations:
    """Which view sees which point, [O] each."""

    view: NDArray[np.int64]  # index of a view
    point: NDArray[np.int64]  # index of a point
    views: int  # how many there are
    points: int

    def __post_init__(self) -> None:
        if self.view.shape != self.point.shape:
            raise ValueError(f"{len(self.view)} views of {len(self.point)} points")

    @property
    def matrix(self) -> csr_matrix:
        """Sparse [views, points], 1 where a view sees a point."""
        ones = np.ones(len(self.view))
        return csr_matrix((ones, (self.view, self.point)), shape=(self.views, self.points))


def split_views(observations: Observations, blocks: int) -> NDArray[np.int64]:
    """Returns the block of each view, [V]; blocks are numbered from 0 in the order of their views.

    The block of most views is cut in two until there are enough: by the smallest normalized cut of
    its covisibility graph that leaves a fifth of the views on each side (Shi and Malik 2000).

    Raises:
        ValueError: there are more blocks than pairs of views.
    """
    if not 1 <= blocks <= max(1, observations.views // 2):
        raise ValueError(f"{blocks} blocks of {observations.views} views")
    return cut_graph((observations.matrix @ observations.matrix.T).astype(np.float64), blocks)


def cut_graph(
    shared: csr_matrix | NDArray[np.float64],  # [V, V], symmetric
    blocks: int,
) -> NDArray[np.int64]:
    """Returns the block of each view, [V], by the weight that every two views share."""
    shared = csr_matrix(shared)
    labels = np.zeros(shared.shape[0], np.int64)
    for new in range(1, blocks):
        rows = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
        labels[rows[_cut(shared[rows][:, rows])]] = new
    _, first = np.unique(labels, return_index=True)
    order = np.argsort(np.argsort(first))
    return np.asarray(order[labels])


def _cut(shared: csr_matrix) -> NDArray[np.bool_]:
    """Returns one side of the cheapest balanced cut of a graph of views, [V]."""
    count = shared.shape[0]
    weights = shared.tolil()
    weights.setdiag(0)
    weights = weights.tocsr()
    degrees = np.asarray(weights.sum(axis=1)).ravel()
    parts, _ = connected_components(weights, directed=False)
    # A faint link between all views makes one graph of parts that share no point.
    faint = 1e-6 * max(1.0, float(degrees.mean())) / count if parts > 1 else 0.0
    order = np.argsort(_fiedler(weights, degrees + faint * count, faint), kind="stable")
    total = degrees.sum()
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    coo = weights.tocoo()
    upper = coo.row < coo.col
    low = np.minimum(place[coo.row[upper]], place[coo.col[upper]])
    high = np.maximum(place[coo.row[upper]], place[coo.col[upper]])
    crossing = np.zeros(count + 1)  # weight of the edges across a cut before each place
    np.add.at(crossing, low + 1, coo.data[upper])
    np.add.at(crossing, high + 1, -coo.data[upper])
    crossing = np.cumsum(crossing)[1:count]
    inside = np.cumsum(degrees[order])[:-1]
    cost = crossing / np.maximum(inside, 1e-9) + crossing / np.maximum(total - inside, 1e-9)
    least = max(1, int(_LEAST_SHARE * count))
    candidates = np.arange(least - 1, count - least)
    best = candidates[np.argmin(cost[candidates])]
    side = np.zeros(count, np.bool_)
    side[order[best + 1:]] = True
    return side


def _fiedler(
    weights: csr_matrix, degrees: NDArray[np.float64], faint: float
) -> NDArray[np.float64]:
    """Returns the second eigenvector of the normalized Laplacian, [V], scaled back."""
    count = weights.shape[0]
    scale = 1 / np.sqrt(np.maximum(degrees, 1e-12))
    if count <= _DENSE or faint:
        dense = (weights.toarray() + faint) * scale[:, None] * scale
        vector = np.linalg.eigh(dense)[1][:, -2]
    else:
        normalized = csr_matrix(weights.multiply(scale[:, None]).multiply(scale))
        values, vectors = eigsh(normalized, k=2, v0=np.ones(count), which="LA")
        vector = vectors[:, np.argmin(values)]
    return np.asarray(vector * scale)


def label_points(
    observations: Observations,
    labels: NDArray[np.int64],  # [V] block of each view
    points: NDArray[np.float64],  # [P, 3]
) -> NDArray[np.int64]:
    """Returns the block of each point, [P]: that of most views, smoothed over its neighbours."""
    blocks = int(labels.max()) + 1
    votes = np.zeros((observations.points, blocks))
    np.add.at(votes, (observations.point, labels[observations.view]), 1)
    seen = votes.sum(axis=1, keepdims=True)
    shares = votes / np.maximum(seen, 1)
    _, near = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    near = near.reshape(len(points), -1)
    for _ in range(_ROUNDS):
        shares = shares[near].mean(axis=1)
    return np.asarray(shares.argmax(axis=1))


def views_of_block(
    observations: Observations,
    point_labels: NDArray[np.int64],  # [P]
    labels: NDArray[np.int64],  # [V]
    block: int,
) -> NDArray[np.bool_]:
    """Returns which views a block is trained on, [V]: its own, and those that see enough of it."""
    seen = np.bincount(observations.view, minlength=observations.views)
    inside = np.bincount(
        observations.view[point_labels[observations.point] == block],
        minlength=observations.views)
    return np.asarray((labels == block) | (inside >= _SEES * np.maximum(seen, 1)))


def context_points(owned: NDArray[np.bool_], seed: int) -> NDArray[np.bool_]:
    """Returns which points a block begins with, [P]: its own, and a seeded draw of the others."""
    drawn = np.random.default_rng(seed).random(len(owned)) < 1 / _CONTEXT
    return np.asarray(owned | drawn)


def observe_points(
    points: NDArray[np.float64],  # [P, 3]
    cameras: Sequence[Camera],
) -> Observations:
    """Returns which cameras see which points where no tracks say so: those that hide no other.

    The view is divided into a grid; of the points in a field those count that are about as near as
    the nearest one.
    """
    views, seen = [], []
    for number, camera in enumerate(cameras):
        pixels, depth = camera.project(points)
        inside = np.flatnonzero(camera.contains(pixels))
        column, line = (pixels[inside] / (camera.width, camera.height) * _GRID).astype(int).T
        field = np.minimum(line, _GRID - 1) * _GRID + np.minimum(column, _GRID - 1)
        nearest = np.full(_GRID**2, np.inf)
        np.minimum.at(nearest, field, depth[inside])
        visible = inside[depth[inside] <= _BEHIND * nearest[field]]
        views.append(np.full(len(visible), number))
        seen.append(visible)
    return Observations(
        np.concatenate(views).astype(np.int64), np.concatenate(seen).astype(np.int64),
        len(cameras), len(points))
