"""Which keypoints of two images have descriptors alike: COLMAP's rules, by exact distances.

COLMAP asks an approximate index on the CPU, once each way. One product of matrices gives all
distances exactly, and with the verification takes half the time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# COLMAP's SiftMatchingOptions: the nearest descriptor is at most this far in units of their length,
# and nearer than this share of the distance of the second.
MAX_DISTANCE, MAX_RATIO = 0.7, 0.8
LENGTH = 512.0  # of COLMAP's descriptors
ROWS = 256  # compared at a time: their distances stay in the cache


def match_descriptors(
    first: NDArray[np.uint8], second: NDArray[np.uint8]  # [N, 128], [M, 128]
) -> NDArray[np.uint32]:
    """Returns the rows of two images that are each other's nearest, and clearly so, [K, 2].

    Distances are exact: sums of products of bytes are integers that float32 holds, in whatever
    order they are added.
    """
    if not len(first) or not len(second):
        return np.zeros((0, 2), np.uint32)
    own, other = _extend(first, swap=False), _extend(second, swap=True)
    buffer = np.empty((min(ROWS, len(own)), len(other)), np.float32)
    rest = np.full(len(other), -np.inf, np.float32)  # nearest to each column but for candidates
    candidates = []
    for start in range(0, len(own), ROWS):
        block = own[start:start + ROWS]
        near = np.matmul(block, other.T, out=buffer[:len(block)])  # minus half squared distances
        rows, best = np.arange(len(block)), near.argmax(axis=1)
        nearest = near[rows, best]
        near[rows, best] = -np.inf
        good = np.flatnonzero(_is_distinct(nearest, near.max(axis=1)))
        near[rows, best] = nearest
        near[good, best[good]] = -np.inf
        np.maximum(rest, near.max(axis=0), out=rest)
        candidates.append((good + start, best[good], nearest[good]))
    rows, columns, values = (np.concatenate(parts) for parts in zip(*candidates, strict=True))
    return _keep_mutual(rows, columns, values, rest)


def _extend(descriptors: NDArray[np.uint8], *, swap: bool) -> NDArray[np.float32]:
    """Returns descriptors [N, 130] whose products are minus half of the squared distances.

    Of the two factors one is made with `swap`.
    """
    rows = np.empty((len(descriptors), descriptors.shape[1] + 2), np.float32)
    rows[:, :-2] = descriptors
    half = -0.5 * np.einsum("nd,nd->n", rows[:, :-2], rows[:, :-2])
    rows[:, -2], rows[:, -1] = (half, 1) if swap else (1, half)
    return rows


def _is_distinct(
    nearest: NDArray[np.float32], second: NDArray[np.float32]  # minus half squared distances, [N]
) -> NDArray[np.bool_]:
    near_enough = nearest >= -0.5 * (MAX_DISTANCE * LENGTH)**2
    return np.asarray(near_enough & (nearest > MAX_RATIO**2 * second))


def _keep_mutual(
    rows: NDArray[np.int64], columns: NDArray[np.int64], values: NDArray[np.float32],
    rest: NDArray[np.float32],
) -> NDArray[np.uint32]:
    """Returns the candidates [K, 2] that are nearest and distinct in their columns as well."""
    order = np.lexsort((-values, columns))
    rows, columns, values = rows[order], columns[order], values[order]
    follows = np.zeros(len(order) + 1, bool)  # the one before, in the same column
    follows[1:-1] = columns[1:] == columns[:-1]
    second = rest[columns]
    has_next = np.flatnonzero(follows[1:])
    second[has_next] = np.maximum(second[has_next], values[has_next + 1])
    kept = ~follows[:-1] & _is_distinct(values, second)
    return np.stack([rows, columns], axis=1)[kept][np.argsort(rows[kept])].astype(np.uint32)
