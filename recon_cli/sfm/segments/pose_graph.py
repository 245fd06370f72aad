"""A graph of frames that bends: what each knows of the next, and loops that pull at them.

Every frame has a similarity of its own, 7 degrees of freedom: a walk drifts in scale, too. Joints
hold frames that follow each other together, each as stiff as it is known; ties are points that two
frames should bring to one place. The similarities of least error leave a drift where it most
likely arose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

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


@dataclass(frozen=True, eq=False)
class Joints:
    """E pairs of nodes that should move alike; deviations are standard ones."""

    nodes: NDArray[np.int64]  # [E, 2]
    places: Array  # [E, 3], where the two meet
    scale: Array  # [E], deviation of the logarithm of their relative scale
    turn: Array  # [E], of their relative rotation, radians
    shift: Array  # [E], of the distance between what they make of the place

    @classmethod
    def joined(cls, parts: Sequence[Joints]) -> Joints:
        """Returns all joints of several, one or more."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts])
                     for field in fields(cls)))


@dataclass(frozen=True, eq=False)
class Ties:
    """T points that two nodes should bring to one place."""

    nodes: NDArray[np.int64]  # [T, 2]
    ours: Array  # [T, 3], as the first node has them
    theirs: Array  # [T, 3], as the second has them
    unit: Array  # [T], standard deviation of their distance

    @classmethod
    def joined(cls, parts: Sequence[Ties]) -> Ties:
        """Returns all ties of several."""
        none = cls(np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        return cls(*(np.concatenate([getattr(part, field.name) for part in (none, *parts)])
                     for field in fields(cls)))


@dataclass(frozen=True, eq=False)
class Motions:
    """A similarity for each of N nodes: x' = scale * rotation @ x + shift."""

    scale: Array  # [N]
    rotation: Array  # [N, 3, 3]
    shift: Array  # [N, 3]

    @classmethod
    def identity(cls, count: int) -> Motions:
        """Returns motions that leave everything where it is."""
        return cls(np.ones(count), np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def __getitem__(self, node: int) -> Similarity:
        return Similarity(float(self.scale[node]), self.rotation[node], self.shift[node])

    def select(self, nodes: NDArray[np.int64]) -> Motions:
        """Returns the motions of nodes by number."""
        return Motions(self.scale[nodes], self.rotation[nodes], self.shift[nodes])

    def points(self, points: Array) -> Array:
        """Returns where the nodes move points [N, 3], one each."""
        turned = np.einsum("nij,nj->ni", self.rotation, points)
        return np.asarray(self.scale[:, None] * turned + self.shift)

    def after(self, step: Array, anchors: Array) -> Motions:
        """Returns motions that first make small ones [N, 7] about anchors [N, 3]."""
        scale = np.exp(step[:, 0])
        turn = Rotation.from_rotvec(step[:, 1:4]).as_matrix()
        shift = anchors + step[:, 4:] - scale[:, None] * np.einsum("nij,nj->ni", turn, anchors)
        # a product of many rotations is kept one
        rotation = Rotation.from_matrix(self.rotation @ turn).as_matrix()
        return Motions(self.scale * scale, rotation, self.points(shift))


def bend(joints: Joints, ties: Ties, anchors: Array) -> Motions:
    """Returns the motions that joints and ties agree on best; the first node rests.

    `anchors` are a place for each node, [N, 3]. Errors of ties count by Cauchy's loss, so that some
    may be wrong.
    """
    unit = float(np.median(joints.shift)) if len(joints.shift) else 1.0
    motions, damping = Motions.identity(len(anchors)), _DAMPING
    error = _sum_errors(joints, ties, motions)
    for _ in range(_ROUNDS):
        rows, jacobian = _linearise(joints, ties, motions, anchors, unit)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ rows
        moved, less = motions, np.inf
        while less > error and damping < _MOST_DAMPING:
            held = csc_matrix(normal + diags(damping * normal.diagonal() + 1e-12))
            step = np.zeros((len(anchors), _PARAMETERS))
            step[1:] = -splu(held).solve(gradient).reshape(-1, _PARAMETERS)
            step[:, 4:] *= unit
            moved = motions.after(step, anchors)
            less = _sum_errors(joints, ties, moved)
            damping *= 10
        if less > error:
            break
        settled = error - less <= _SETTLED * error
        motions, error, damping = moved, less, max(damping / 100, _LEAST_DAMPING)
        if settled:
            break
    return motions


def measure_ties(ties: Ties, motions: Motions) -> Array:  # [T]
    """Returns how far apart the points of ties are, in standard deviations."""
    errors = _tie_errors(ties, *(motions.select(ties.nodes[:, side]) for side in (0, 1)))
    return np.asarray(np.linalg.norm(errors, axis=1))


def _joint_errors(joints: Joints, first: Motions, second: Motions) -> Array:  # [E, 7]
    """Returns by how many standard deviations joints are bent."""
    between = np.swapaxes(first.rotation, 1, 2) @ second.rotation
    apart = first.points(joints.places) - second.points(joints.places)
    apart /= np.sqrt(first.scale * second.scale)[:, None]
    return np.column_stack([
        np.log(first.scale / second.scale) / joints.scale,
        Rotation.from_matrix(between).as_rotvec() / joints.turn[:, None],
        apart / joints.shift[:, None]])


def _tie_errors(ties: Ties, first: Motions, second: Motions) -> Array:  # [T, 3]
    # By the scale of both, or all would be closest together in a scene that shrinks.
    apart = first.points(ties.ours) - second.points(ties.theirs)
    return np.asarray(apart / (ties.unit * np.sqrt(first.scale * second.scale))[:, None])


def _sum_errors(joints: Joints, ties: Ties, motions: Motions) -> float:
    bent = _joint_errors(joints, *(motions.select(joints.nodes[:, side]) for side in (0, 1)))
    return float((bent**2).sum() + np.log1p(measure_ties(ties, motions) ** 2).sum())


def _linearise(
    joints: Joints, ties: Ties, motions: Motions, anchors: Array, unit: float
) -> tuple[Array, csc_matrix]:
    """Returns all errors, [R], and their derivatives by all nodes but the first, [R, 7 (N - 1)]."""
    # Cauchy's loss as weights of squared errors.
    weights = 1 / np.sqrt(1 + measure_ties(ties, motions) ** 2)[:, None]
    parts: tuple[tuple[NDArray[np.int64], Callable[[Motions, Motions], Array]], ...] = (
        (joints.nodes, lambda ours, theirs: _joint_errors(joints, ours, theirs)),
        (ties.nodes, lambda ours, theirs: weights * _tie_errors(ties, ours, theirs)))
    values, entries, columns, rows = [], [], [], []
    start = 0
    for nodes, errors in parts:
        both = [motions.select(nodes[:, side]) for side in (0, 1)]
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
