"""Loops of a walk that a model leaves open: two stretches show one place, and the model has two.

Where a walk comes back, frames far apart in time match. If the cameras have drifted, these matches
contradict the model, and the mapper drops them, so that it stays wrong. Such matches
agree with each other on one motion, which brings the two copies of the place together. Places that
only look alike give such a motion as well, but it is larger than what a way drifts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.sfm.limits import (
    MAX_DRIFT,
    MAX_DRIFT_DEG,
    MAX_POINT_ERROR,
    MIN_LOOP_SHARE,
    NEAR_IN_WALK,
)
from recon_cli.sfm.segments.shared_points import estimate_similarity
from recon_cli.sfm.verdict.evidence import MatchEvidence
from recon_cli.workspace.json_record import JsonRecord

# Share of the points that are in one place already above which the loop is closed.
CLOSED = 0.2


@dataclass(frozen=True)
class OpenLoop(JsonRecord):
    """Two stretches of a walk that show the same place, which the model has twice."""

    first: str  # an image of the earlier stretch
    second: str  # the image of the later one that it has most matches with
    pairs: int  # of images, whose matches contradict the model
    points: int  # that agree on one motion
    scale: float  # of that motion, from the later stretch to the earlier one
    turn_deg: float
    shift: float  # how far it moves the points, as a share of the way between the stretches


def find_open_loops(
    evidence: MatchEvidence, order: NDArray[np.int64] | None, *, seed: int = 0
) -> tuple[OpenLoop, ...]:
    """Returns the loops that a model leaves open; none where the images' order is not known.

    `order` are the images with a camera as they were taken.
    """
    if order is None:
        return ()
    place = np.full(len(evidence.names), -1)
    place[order] = np.arange(len(order))
    loops = [_judge(evidence, place, order, rows, seed)
             for rows in _groups(evidence, place)]
    return tuple(sorted((loop for loop in loops if loop is not None),
                        key=lambda loop: -loop.points))


def _groups(evidence: MatchEvidence, place: NDArray[np.int64]) -> Iterator[list[int]]:
    """Yields pairs, by row, that contradict the model and lie beside each other, the best first."""
    left = sorted(evidence.doubled, key=lambda row: (-int(evidence.matches[row]), row))
    while left:
        ends = np.sort(place[evidence.pairs[left]], axis=1)
        near = (np.abs(ends - ends[0]) <= NEAR_IN_WALK).all(axis=1)
        group = [row for row, close in zip(left, near, strict=True) if close]
        left = [row for row, close in zip(left, near, strict=True) if not close]
        firsts, seconds = ends[near].T
        if len(set(firsts)) > 1 and len(set(seconds)) > 1:  # one blurred image proves nothing
            yield group


def _judge(
    evidence: MatchEvidence, place: NDArray[np.int64], order: NDArray[np.int64],
    rows: Sequence[int], seed: int,
) -> OpenLoop | None:
    """Returns the loop that some pairs leave open; None if they agree on nothing, or it is closed.
    """
    later, earlier = _shown_points(evidence, place, rows)
    first, second = sorted(evidence.pairs[rows[0]], key=lambda image: place[image])
    max_error = MAX_POINT_ERROR * float(evidence.depths[first])
    agreed = estimate_similarity(
        later, earlier, max_error=max_error, min_share=MIN_LOOP_SHARE, seed=seed)
    if agreed is None:
        return None
    apart = np.linalg.norm(later - earlier, axis=1)
    if np.count_nonzero(apart <= max_error) > CLOSED * len(agreed.rows):
        return None
    turn = agreed.turn_deg
    path = evidence.centers[order[place[first]:place[second] + 1]]
    way = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    shift = float(np.median(apart)) / max(way, 1e-12)
    if turn > MAX_DRIFT_DEG or shift > MAX_DRIFT:
        return None
    return OpenLoop(evidence.names[first], evidence.names[second], len(rows),
                    len(agreed.rows), agreed.motion.scale, turn, shift)


def _shown_points(
    evidence: MatchEvidence, place: NDArray[np.int64], rows: Collection[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # [K, 3], [K, 3]
    """Returns the points that matching keypoints show, of the later and the earlier image."""
    shown: set[tuple[int, int]] = set()
    for row in rows:
        points = evidence.doubled[row]
        first, second = place[evidence.pairs[row]]
        shown |= set(map(tuple, (points if first > second else points[:, ::-1]).tolist()))
    both = np.array(sorted(shown), np.int64).reshape(-1, 2)
    return evidence.positions[both[:, 0]], evidence.positions[both[:, 1]]
