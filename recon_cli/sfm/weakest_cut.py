"""Where a model is most likely broken: the cut whose matches agree least with the poses.

A mapper that goes wrong at one frame builds two good halves and places them wrongly to each other,
with a small reprojection error over the matches that it kept. Those that it rejected show the
break: across it, matches disagree with the poses.

Matches of two places that look alike are rejected rightly, so a cut is ignored when its two sides
show the same surfaces (`visual_aliasing`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.sfm import view_graph
from recon_cli.sfm.evidence import MatchEvidence
from recon_cli.sfm.view_graph import Cut, Weights
from recon_cli.sfm.visual_aliasing import Overlap, is_confirmed

# Least share measured in each model: 0.73 to 0.99 where no camera was off by 1% of the extent;
# 0.03, 0.35 and 0.49 where 9, 7 and 8 of 50 cameras were off by two thirds of it, at reprojection
# errors of 1.0 and 0.3 pixels.
MIN_AGREEING = 0.5
# COLMAP gives an image a camera from 30 inliers on (abs_pose_min_num_inliers).
MIN_MATCHES = 30
# Sides of up to this share of the cameras are outliers, which can be dropped.
MAX_OUTLIERS = 0.1


@dataclass(frozen=True)
class WeakestCut:
    """The cut through a model whose matches agree least with the poses."""

    share: float | None  # of the matches across, those that agree with the poses; None if unknown
    reason: str  # why it is unknown; empty otherwise
    sides: tuple[tuple[str, ...], tuple[str, ...]]  # names of the images, the smaller side first
    pairs: int  # verified, across
    matches: int  # verified, across
    points: int  # of the model that images of both sides see, counted for every pair of them
    normalised_cut: float  # points across over those of the lighter side, 0 (apart) to 1


@dataclass(frozen=True)
class OutlierCamera:
    """A camera that the image's own matches contradict."""

    name: str
    share: float  # of its matches with cameras that are no outliers, those that agree
    matches: int  # with such cameras


def find_weakest_cut(
    evidence: MatchEvidence, overlap: Overlap
) -> tuple[WeakestCut, tuple[OutlierCamera, ...]]:
    """Returns the weakest cut of the cameras that are no outliers, and the outliers.

    Small sides of broken cuts are removed one by one, so that a wrong camera hides behind no other.
    """
    links = _Links.of(evidence, overlap)
    inliers = evidence.registered.copy()
    allowed = max(1, int(MAX_OUTLIERS * np.count_nonzero(inliers)))
    while (side := _worst_side(links, inliers)) is not None:
        count = np.count_nonzero(evidence.registered & ~inliers) + np.count_nonzero(side)
        if links.share(side, inliers) >= MIN_AGREEING or count > allowed:
            return _cut(evidence, links, side, inliers), _outliers(evidence, links, inliers)
        inliers &= ~side
    reason = f"no two parts have {MIN_MATCHES} verified matches between them"
    return WeakestCut(None, reason, ((), ()), 0, 0, 0, 0.0), _outliers(evidence, links, inliers)


@dataclass(frozen=True)
class _Links:
    """Weights between the images, each [N, N] over all of them."""

    matches: Weights
    agreeing: Weights
    shared: Weights
    expected: Weights
    confirmed: Weights

    @classmethod
    def of(cls, evidence: MatchEvidence, overlap: Overlap) -> _Links:
        """Returns the matrices; matches of images without a camera are left out."""
        count, placed = len(evidence.names), evidence.placed
        pairs = evidence.pairs[placed]
        return cls(
            view_graph.weights(count, pairs, evidence.matches[placed]),
            view_graph.weights(count, pairs, evidence.agreeing[placed]),
            evidence.shared.astype(np.float64), overlap.expected, overlap.confirmed)

    def among(self, rows: NDArray[np.int64]) -> _Links:
        """Returns the links of some images alone."""
        inner = np.ix_(rows, rows)
        return _Links(*(matrix[inner] for matrix in vars(self).values()))

    def share(self, side: Cut, inliers: Cut) -> float:
        """Returns the share of the matches from a side to the rest that agree."""
        rest = np.ix_(side, inliers & ~side)
        return float(self.agreeing[rest].sum() / max(self.matches[rest].sum(), 1.0))


def _worst_side(links: _Links, inliers: Cut) -> Cut | None:
    """Returns the smaller side, [N], of the cut with the least share; None where none is known."""
    rows = np.flatnonzero(inliers)
    if len(rows) < 2:
        return None
    inner = links.among(rows)
    alone = _shares(*(matrix.sum(axis=1) for matrix in (
        inner.agreeing, inner.matches, inner.expected, inner.confirmed)))
    best, least = np.array([alone.argmin()]), alone.min()
    # A model also breaks elsewhere than between parts that share few points.
    for order in (*view_graph.loose_orders(inner.shared),
                  *view_graph.disagreement_orders(inner.agreeing, inner.matches)):
        shares = _shares(*(view_graph.sweep(matrix, order) for matrix in (
            inner.agreeing, inner.matches, inner.expected, inner.confirmed)))
        if shares.min() < least:
            best, least = order[:int(shares.argmin()) + 1], shares.min()
    if np.isinf(least):
        return None
    side = np.zeros_like(inliers)
    side[rows[best]] = True
    return side if 2 * len(best) <= len(rows) else inliers & ~side


def _shares(
    agreeing: NDArray[np.float64],  # [C]
    matches: NDArray[np.float64],  # [C]
    expected: NDArray[np.float64],  # [C]
    confirmed: NDArray[np.float64],  # [C]
) -> NDArray[np.float64]:  # [C]
    """Returns the share of each cut, infinite where it says nothing.

    That is so where too few matches lie across, and where they disagree although the two sides show
    what they should: then the matches of places that look alike were rightly rejected.
    """
    shares = agreeing / np.maximum(matches, 1)
    alike = (shares < MIN_AGREEING) & is_confirmed(expected, confirmed)
    return np.where((matches >= MIN_MATCHES) & ~alike, shares, np.inf)


def _cut(evidence: MatchEvidence, links: _Links, side: Cut, inliers: Cut) -> WeakestCut:
    other = inliers & ~side
    across = np.ix_(side, other)
    rows = np.flatnonzero(inliers)
    names = np.array(evidence.names)
    return WeakestCut(
        share=links.share(side, inliers), reason="",
        sides=(tuple(names[side].tolist()), tuple(names[other].tolist())),
        pairs=int(np.count_nonzero(links.matches[across])),
        matches=int(links.matches[across].sum()), points=int(links.shared[across].sum()),
        normalised_cut=view_graph.conductance(links.shared[np.ix_(rows, rows)], side[rows]))


def _outliers(evidence: MatchEvidence, links: _Links, inliers: Cut) -> tuple[OutlierCamera, ...]:
    outliers = []
    for index in np.flatnonzero(evidence.registered & ~inliers):
        matches = links.matches[index, inliers].sum()
        share = links.agreeing[index, inliers].sum() / max(matches, 1.0)
        outliers.append(OutlierCamera(evidence.names[index], float(share), int(matches)))
    return tuple(outliers)
