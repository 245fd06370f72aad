"""Graphs of images as symmetric weight matrices [N, N]: their pieces, and where they come apart.

A cut parts the images in two. Those tried here come from sweeps (the images in some order, cut
after each of them but the last) and from the edges of a tree.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import (
    connected_components,
    depth_first_order,
    minimum_spanning_tree,
)

Weights = NDArray[np.float64]  # [N, N], symmetric, zero on the diagonal
Order = NDArray[np.int64]  # [N], a permutation of the images
Cut = NDArray[np.bool_]  # [N], the images of one side

# Eigenvectors that are swept: one finds the worst cut, the others look for a second break.
VECTORS = 4
# Share of the mean weight of an image that is added to each, so that none is 0.
RIDGE = 1e-6


def weights(
    count: int,
    pairs: NDArray[np.int64],  # [P, 2]
    values: NDArray[np.int64],  # [P]
) -> Weights:
    """Returns the [count, count] matrix that holds the value of each pair of images."""
    matrix = np.zeros((count, count))
    matrix[pairs[:, 0], pairs[:, 1]] = values
    return matrix + matrix.T


def components(matrix: Weights) -> list[NDArray[np.int64]]:
    """Returns the images of each connected piece, sorted, the largest piece first."""
    count, labels = connected_components(matrix > 0, directed=False)
    pieces = [np.flatnonzero(labels == label) for label in range(count)]
    return sorted(pieces, key=lambda piece: (-len(piece), int(piece[0])))


def across(matrix: Weights, cut: Cut) -> float:
    """Returns the weight between the two sides of a cut."""
    return float(matrix[np.ix_(cut, ~cut)].sum())


def conductance(matrix: Weights, cut: Cut) -> float:
    """Returns the weight across over all weight of the lighter side, 0 (apart) to 1.

    It lies between half of Shi and Malik's normalised cut (2000) and all of it.
    """
    volume = float(min(matrix[cut].sum(), matrix[~cut].sum()))
    return across(matrix, cut) / volume if volume > 0 else 0.0


def sweep(matrix: Weights, order: Order) -> NDArray[np.float64]:
    """Returns the weight across each cut of a sweep, [N - 1], the first after the first image."""
    ordered = matrix[np.ix_(order, order)]
    sums = ordered.cumsum(axis=0).cumsum(axis=1)
    head = np.arange(len(order) - 1)
    return np.asarray(sums[head, -1] - sums[head, head])


def spanning_forest(matrix: Weights) -> NDArray[np.bool_]:  # [N, N], symmetric
    """Returns the edges of the trees that hold the images together by the strongest ties.

    No tie between the two sides of an edge of it is stronger than that edge.
    """
    lengths = np.divide(1.0, matrix, out=np.zeros_like(matrix), where=matrix > 0)
    tree = minimum_spanning_tree(lengths).toarray() > 0
    return np.asarray(tree | tree.T)


def strongest_ties(matrix: Weights, count: int) -> NDArray[np.bool_]:  # [N, N], symmetric
    """Returns which images are among the `count` strongest ties of one of the two, or in a tree."""
    ties = spanning_forest(matrix)
    partners = np.argsort(-matrix, axis=1, kind="stable")[:, :count]
    np.put_along_axis(ties, partners, values=True, axis=1)
    return np.asarray((ties | ties.T) & (matrix > 0))


def tree_cuts(forest: NDArray[np.bool_]) -> Iterator[Cut]:
    """Yields, for each edge of a forest, the images on the side of its first one in its tree."""
    graph, seen = csr_matrix(forest), np.zeros(len(forest), np.bool_)
    for root in range(len(forest)):
        if seen[root]:
            continue
        order, parents = depth_first_order(graph, root, directed=False)
        seen[order] = True
        # The images below one follow it in this order.
        place = np.empty(len(forest), np.int64)
        place[order] = np.arange(len(order))
        below = np.ones(len(order), np.int64)
        for node in order[:0:-1]:
            below[place[parents[node]]] += below[place[node]]
        for start in range(1, len(order)):
            cut = np.zeros(len(forest), np.bool_)
            cut[order] = order[start] > parents[order[start]]
            cut[order[start:start + below[start]]] ^= True
            yield cut


def loose_orders(matrix: Weights) -> Iterator[Order]:
    """Yields orders by eigenvectors of the normalised Laplacian (Shi and Malik 2000, eq. 11)."""
    yield from _orders(matrix, np.diag(matrix.sum(axis=1)))


def disagreement_orders(part: Weights, whole: Weights) -> Iterator[Order]:
    """Yields orders in which a cut leaves a small share of the weight across: part over whole.

    With the Laplacians L of both graphs and x = 1 on one side of a cut and 0 on the other, that
    share is x'L_part x / x'L_whole x; the eigenvectors minimise it over real x.
    """
    yield from _orders(part, _laplacian(whole))


def _orders(matrix: Weights, scale: NDArray[np.float64]) -> Iterator[Order]:  # scale: [N, N]
    count = len(matrix)
    if count < 2:
        return
    scale = scale + RIDGE * max(float(np.trace(scale)) / count, 1.0) * np.eye(count)
    # The constant vector, which cuts nothing, is taken out: what is left is orthogonal to it in
    # the metric of `scale`, as the other eigenvectors are.
    constant = scale @ np.ones(count)
    basis = linalg.null_space(constant[None])
    _, vectors = linalg.eigh(
        basis.T @ _laplacian(matrix) @ basis, basis.T @ scale @ basis,
        subset_by_index=(0, min(VECTORS, count - 1) - 1))
    for vector in (basis @ vectors).T:
        yield np.argsort(vector, kind="stable")


def _laplacian(matrix: Weights) -> NDArray[np.float64]:
    return np.asarray(np.diag(matrix.sum(axis=1)) - matrix)
