"""Fewer Gaussians that look alike from afar: neighbours are merged in pairs.

A pair becomes the Gaussian with its mass, mean and covariance (moment matching), as in the levels
of "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets"
(Kerbl et al. 2024, section 4.2). Mass is opacity times visible area.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from recon_cli.scene.splats import LEAST_OPACITY, MOST_OPACITY, SH_C0, Splats

GROUP = 4  # Gaussians that one of the next level stands for, on the mean
_NEIGHBOURS = 8  # that a Gaussian may be merged with
_ROUNDS = 6  # of matching on one set of neighbours; most find a partner
_COLOR = 10.0  # cost of a colour difference of 1, relative to a distance of one radius, squared
_EVERY = 0.05  # cost of any merge, in the same unit

Doubles = NDArray[np.float64]
Rows = NDArray[np.int64]


def coarsen(splats: Splats, count: int) -> Splats:
    """Returns at most `count` Gaussians (at least one) that stand for all; the order is a new one.

    All of them have coefficients if any has. Pairs that change least are merged first.
    """
    current = Moments.from_splats(splats)
    while len(current.mass) > max(1, count):
        current = _merge_once(current, len(current.mass) - max(1, count))
    return current.splats()


class Moments:
    """N Gaussians by mass, mean and covariance, with colours [N, 1 + T, 3] as coefficients."""

    def __init__(self, mass: Doubles, mean: Doubles, covariance: Doubles, color: Doubles) -> None:
        self.mass, self.mean, self.covariance, self.color = mass, mean, covariance, color

    @classmethod
    def from_splats(cls, splats: Splats) -> Moments:
        """Returns the moments of Gaussians."""
        scales = np.exp(_array(splats.log_scales))
        quats = _array(splats.quats)
        length = np.linalg.norm(quats, axis=1, keepdims=True)
        quats = np.where(length > 0, quats / np.where(length > 0, length, 1), [1.0, 0, 0, 0])
        axes = Rotation.from_quat(quats, scalar_first=True).as_matrix() * scales[:, None]
        rest = np.zeros((len(splats), *splats.sh_rest.shape[1:]))
        rest[: len(splats.sh_rest)] = _array(splats.sh_rest)
        opacity = 1 / (1 + np.exp(-_array(splats.logit_opacities)))
        return cls(
            opacity * _area(scales), _array(splats.means), axes @ axes.transpose(0, 2, 1),
            np.concatenate([_array(splats.sh_dc)[:, None], rest], axis=1))

    def select(self, rows: NDArray[np.bool_] | Rows) -> Moments:
        """Returns some of them."""
        return Moments(
            self.mass[rows], self.mean[rows], self.covariance[rows], self.color[rows])

    def splats(self) -> Splats:
        """Returns them as float32 tensors."""
        variances, axes = np.linalg.eigh(self.covariance)
        axes[np.linalg.det(axes) < 0, :, 0] *= -1  # eigenvectors may form a mirror image
        scales = np.sqrt(np.maximum(variances, 1e-30))
        opacity = np.clip(self.mass / _area(scales), LEAST_OPACITY, MOST_OPACITY)
        values = {
            "means": self.mean, "quats": Rotation.from_matrix(axes).as_quat(scalar_first=True),
            "log_scales": np.log(scales), "logit_opacities": np.log(opacity / (1 - opacity)),
            "sh_dc": self.color[:, 0], "sh_rest": self.color[:, 1:]}
        return Splats.from_parameters({
            name: torch.from_numpy(np.ascontiguousarray(value, np.float32))
            for name, value in values.items()})


def _array(values: torch.Tensor) -> Doubles:
    return values.detach().cpu().numpy().astype(np.float64)


def _area(scales: Doubles) -> Doubles:
    """Returns the visible area of ellipsoids [N, 3], roughly: the product of the longer axes."""
    return np.asarray(np.sort(scales, axis=1)[:, 1:].prod(axis=1))


def _merge_once(moments: Moments, most: int) -> Moments:
    """Returns the Gaussians after at most `most` merges; each takes part in one."""
    return merge_pairs(moments, *match_pairs(moments, most))


def merge_pairs(moments: Moments, first: Rows, second: Rows) -> Moments:
    """Returns the Gaussians that are in no pair, in their order, and then the merged pairs."""
    pairs = [moments.select(first), moments.select(second)]
    mass = pairs[0].mass + pairs[1].mass
    shares = [pair.mass / mass for pair in pairs]
    mean = sum(share[:, None] * pair.mean for share, pair in zip(shares, pairs, strict=True))
    covariance = np.zeros((len(first), 3, 3))
    color = np.zeros_like(pairs[0].color)
    for share, pair in zip(shares, pairs, strict=True):
        away = pair.mean - mean
        spread = away[:, :, None] * away[:, None]
        covariance += share[:, None, None] * (pair.covariance + spread)
        color += share[:, None, None] * pair.color
    alone = np.ones(len(moments.mass), np.bool_)
    alone[first] = alone[second] = False
    kept = moments.select(alone)
    return Moments(
        np.concatenate([kept.mass, mass]), np.concatenate([kept.mean, mean]),
        np.concatenate([kept.covariance, covariance]), np.concatenate([kept.color, color]))


def match_pairs(moments: Moments, most: int) -> tuple[Rows, Rows]:
    """Returns the rows of at most `most` pairs of neighbours, the cheapest of those found."""
    count = len(moments.mass)
    _, near = cKDTree(moments.mean).query(
        moments.mean, min(count, _NEIGHBOURS + 1), workers=-1)
    near = near.astype(np.int64)
    near[near == np.arange(count)[:, None]] = -1
    cost = _costs(moments, near)
    free = np.ones(count, np.bool_)
    found: list[tuple[Rows, Rows, Doubles]] = []
    rows = np.arange(count)
    for _ in range(_ROUNDS):
        open_costs = np.where(free[near] & (near >= 0) & free[:, None], cost, np.inf)
        choice = open_costs.argmin(axis=1)
        best, least = near[rows, choice], open_costs[rows, choice]
        # Each proposes to its best neighbour. A pair that is the cheapest for both is accepted:
        # there always is one, though neighbours need not be each other's.
        proposers = np.flatnonzero(np.isfinite(least))
        if not len(proposers):
            break
        proposers = proposers[np.argsort(least[proposers], kind="stable")]
        targets, rank = best[proposers], np.arange(len(proposers))
        cheapest = np.full(count, len(proposers))
        np.minimum.at(cheapest, proposers, rank)
        np.minimum.at(cheapest, targets, rank)
        accepted = (cheapest[proposers] == rank) & (cheapest[targets] == rank)
        pairs = proposers[accepted], targets[accepted], least[proposers[accepted]]
        free[pairs[0]] = free[pairs[1]] = False
        found.append(pairs)
    if not found:  # costs overflow: any two will do
        return rows[:1], rows[1:2]
    first, second, costs = (np.concatenate(part) for part in zip(*found, strict=True))
    chosen = np.argsort(costs, kind="stable")[:most]
    return first[chosen], second[chosen]


def _costs(moments: Moments, near: Rows) -> Doubles:
    """Returns the cost of merging each Gaussian with each of its neighbours [N, K]."""
    cost = np.empty(near.shape)
    variance = np.trace(moments.covariance, axis1=1, axis2=2) / 3
    color = SH_C0 * moments.color[:, 0]
    for column in range(near.shape[1]):  # one at a time: millions of Gaussians take gigabytes
        other = near[:, column]
        distance = np.square(moments.mean - moments.mean[other]).sum(axis=1)
        between = distance / (variance + variance[other] + 1e-30)
        colors = np.square(color - color[other]).sum(axis=1)
        lighter = moments.mass * moments.mass[other] / (moments.mass + moments.mass[other])
        cost[:, column] = lighter * (_EVERY + between + _COLOR * colors)
    return cost
