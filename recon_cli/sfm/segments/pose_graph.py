"""A pose graph: what each frame knows of the next, and points that close its loops.

Every frame has a similarity of its own (Sim3, 7 degrees of freedom): a walk drifts in scale, too.
Edges say how frames that follow each other lie to one another, each with the deviations that it is
known to; point constraints are points that two frames should bring to one place. The poses of
least error leave a drift where it most likely arose (Strasdat et al. 2010).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from recon_cli.scene.similarity import Similarity

Array = NDArray[np.float64]

_PARAMETERS = 7  # of a node: log scale, rotation vector, shift
_STEP = 1e-6  # of a numeric derivative
_ROUNDS, _SETTLED = 40, 1e-6  # most steps, and the relative change of the error that ends them
# Of Levenberg and Marquardt: at first, least, and where no step is short enough to help.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-9, 1e3


class _Rows:
    """Arrays with a row for each of several things."""

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Returns the rows of several, one or more."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts])
                     for field in fields(cls)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Edges(_Rows):
    """E pairs of nodes that should move alike; deviations are standard ones."""

    nodes: NDArray[np.int64]  # [E, 2]
    places: Array  # [E, 3], where the two meet
    scale: Array  # [E], deviation of the logarithm of their relative scale
    turn: Array  # [E], of their relative rotation, radians
    shift: Array  # [E], of the distance between what they make of the place


@dataclass(frozen=True, eq=False)
class Constraints(_Rows):
    """T points that two nodes should bring to one place."""

    nodes: NDArray[np.int64]  # [T, 2]
    ours: Array  # [T, 3], as the first node has them
    theirs: Array  # [T, 3], as the second has them
    unit: Array  # [T], standard deviation of their distance


@dataclass(frozen=True, eq=False)
class Poses:
    """A similarity for each of N nodes: x' = scale * rotation @ x + translation."""

    scale: Array  # [N]
    rotation: Array  # [N, 3, 3]
    translation: Array  # [N, 3]

    @classmethod
    def identity(cls, count: int) -> Poses:
        """Returns poses that leave everything where it is."""
        return cls(np.ones(count), np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def __getitem__(self, node: int) -> Similarity:
        return Similarity(float(self.scale[node]), self.rotation[node], self.translation[node])

    def select(self, nodes: NDArray[np.int64]) -> Poses:
        """Returns the poses of nodes by number."""
        return Poses(self.scale[nodes], self.rotation[nodes], self.translation[nodes])

    def points(self, points: Array) -> Array:
        """Returns where the nodes move points [N, 3], one each."""
        turned = np.einsum("nij,nj->ni", self.rotation, points)
        return np.asarray(self.scale[:, None] * turned + self.translation)

    def after(self, step: Array, anchors: Array) -> Poses:
        """Returns poses that first make small steps [N, 7] about anchors [N, 3]."""
        scale = np.exp(step[:, 0])
        turn = Rotation.from_rotvec(step[:, 1:4]).as_matrix()
        shift = anchors + step[:, 4:] - scale[:, None] * np.einsum("nij,nj->ni", turn, anchors)
        # a product of many rotations is kept one
        rotation = Rotation.from_matrix(self.rotation @ turn).as_matrix()
        return Poses(self.scale * scale, rotation, self.points(shift))


def optimize(edges: Edges, constraints: Constraints, anchors: Array) -> Poses:
    """Returns the poses of least error; the first node stays.

    `anchors` are a place for each node, [N, 3]. Constraints count by Cauchy's loss, so that some
    may be wrong.
    """
    unit = float(np.median(edges.shift)) if len(edges.shift) else 1.0
    poses, damping = Poses.identity(len(anchors)), _DAMPING
    error = _sum_errors(edges, constraints, poses)
    for _ in range(_ROUNDS):
        rows, jacobian = _linearise(edges, constraints, poses, anchors, unit)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ rows
        moved, less = poses, np.inf
        while less > error and damping < _MOST_DAMPING:
            damped = csc_matrix(normal + diags(damping * normal.diagonal() + 1e-12))
            step = np.zeros((len(anchors), _PARAMETERS))
            step[1:] = -splu(damped).solve(gradient).reshape(-1, _PARAMETERS)
            step[:, 4:] *= unit
            moved = poses.after(step, anchors)
            less = _sum_errors(edges, constraints, moved)
            damping *= 10
        if less > error:
            break
        settled = error - less <= _SETTLED * error
        poses, error, damping = moved, less, max(damping / 100, _LEAST_DAMPING)
        if settled:
            break
    return poses


def measure_residuals(constraints: Constraints, poses: Poses) -> Array:  # [T]
    """Returns how far apart the points of constraints are, in standard deviations."""
    both = (poses.select(constraints.nodes[:, side]) for side in (0, 1))
    return np.asarray(np.linalg.norm(_point_residuals(constraints, *both), axis=1))


def _edge_residuals(edges: Edges, first: Poses, second: Poses) -> Array:  # [E, 7]
    """Returns by how many standard deviations poses are off the edges."""
    between = np.swapaxes(first.rotation, 1, 2) @ second.rotation
    apart = first.points(edges.places) - second.points(edges.places)
    apart /= np.sqrt(first.scale * second.scale)[:, None]
    return np.column_stack([
        np.log(first.scale / second.scale) / edges.scale,
        Rotation.from_matrix(between).as_rotvec() / edges.turn[:, None],
        apart / edges.shift[:, None]])


def _point_residuals(constraints: Constraints, first: Poses, second: Poses) -> Array:  # [T, 3]
    # By the scale of both, or all would be closest together in a scene that shrinks.
    apart = first.points(constraints.ours) - second.points(constraints.theirs)
    return np.asarray(apart / (constraints.unit * np.sqrt(first.scale * second.scale))[:, None])


def _sum_errors(edges: Edges, constraints: Constraints, poses: Poses) -> float:
    residuals = _edge_residuals(edges, *(poses.select(edges.nodes[:, side]) for side in (0, 1)))
    return float((residuals**2).sum() + np.log1p(measure_residuals(constraints, poses) ** 2).sum())


def _linearise(
    edges: Edges, constraints: Constraints, poses: Poses, anchors: Array, unit: float
) -> tuple[Array, csc_matrix]:
    """Returns all errors, [R], and their derivatives by all nodes but the first, [R, 7 (N - 1)]."""
    # Cauchy's loss as weights of squared errors.
    weights = 1 / np.sqrt(1 + measure_residuals(constraints, poses) ** 2)[:, None]
    parts: tuple[tuple[NDArray[np.int64], Callable[[Poses, Poses], Array]], ...] = (
        (edges.nodes, lambda ours, theirs: _edge_residuals(edges, ours, theirs)),
        (constraints.nodes,
         lambda ours, theirs: weights * _point_residuals(constraints, ours, theirs)))
    values, entries, columns, rows = [], [], [], []
    start = 0
    for nodes, errors in parts:
        both = [poses.select(nodes[:, side]) for side in (0, 1)]
        value = errors(*both)
        row = start + np.arange(value.size)
        for side, parameter in np.ndindex(2, _PARAMETERS):
            step = np.zeros((len(nodes), _PARAMETERS))
            step[:, parameter] = _STEP * (unit if parameter >= 4 else 1.0)
            moved = list(both)
            moved[side] = both[side].after(step, anchors[nodes[:, side]])
            entries.append(((errors(*moved) - value) / _STEP).ravel())
            columns.append(np.repeat(
                _PARAMETERS * (nodes[:, side] - 1) + parameter, value.shape[1]))
            rows.append(row)
        values.append(value.ravel())
        start += value.size
    column = np.concatenate(columns)
    free = column >= 0
    jacobian = csc_matrix(
        (np.concatenate(entries)[free], (np.concatenate(rows)[free], column[free])),
        (start, _PARAMETERS * (len(anchors) - 1)))
    return np.concatenate(values), jacobian
