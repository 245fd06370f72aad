"""Where a model is most likely broken: the cut across which the fewest matches bear out the poses.

A mapper that takes the wrong turn at one frame builds two good halves and sets them wrongly to each
other. Every image has a camera then, and the reprojection error, which is taken over the matches
that the mapper kept, is small. The matches that it had to leave out tell: those across the break
disagree with the poses. All matches together hardly show it, since few lie across.

Matches can also be wrong and rightly be left out: two places that look alike match each other. So a
cut is passed over when its two sides show what they should (`overlap`), which those of a broken
model do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.sfm import view_graph
from recon_cli.sfm.evidence import Evidence
from recon_cli.sfm.view_graph import Cut, Order, Weights
from recon_cli.sfm.visual_aliasing import Overlap, borne_out

# Least share measured in each model: 0.73 to 0.99 where no camera was off by 1% of the extent;
# 0.03, 0.35 and 0.49 where 9, 7 and 8 of 50 cameras were off by two thirds of it, at reprojection
# errors of 1.0 and 0.3 pixels. The cut that is loosest by its points alone held 0.89 in the first
# of these: it ran elsewhere. The other two are a room with two equal posters.
MIN_WEAK_LINK = 0.5
# COLMAP gives an image a camera from 30 inliers on (abs_pose_min_num_inliers), so that no part of a
# model hangs on fewer.
MIN_MATCHES = 30
# Sides of up to this share of the cameras are images gone astray, which can be dropped; a larger
# one is half a model, and nothing says which half is right.
MAX_ASTRAY = 0.1


@dataclass(frozen=True)
class WeakLink:
    """The cut through a model whose matches agree least with the poses.

    Attributes:
        share: of the matches across, those that agree with the poses; None where it cannot be told.
        reason: why it cannot be told; empty otherwise.
        sides: names of the images on both sides, the smaller side first.
        pairs: verified pairs of images across.
        matches: verified matches across.
        points: points of the model that images of both sides see, counted for every pair of them.
        normalised_cut: points across over those of the lighter side, 0 (apart) to 1.
    """

    share: float | None
    reason: str
    sides: tuple[tuple[str, ...], tuple[str, ...]]
    pairs: int
    matches: int
    points: int
    normalised_cut: float


@dataclass(frozen=True)
class Astray:
    """A camera that the image's own matches contradict.

    Attributes:
        name: of the image.
        share: of its matches with cameras that are not astray, those that agree with the poses;
            zero where there are none.
        matches: how many those are.
    """

    name: str
    share: float
    matches: int


def find(evidence: Evidence, overlap: Overlap) -> tuple[WeakLink, tuple[Astray, ...]]:
    """Returns the weakest link of the cameras that are not astray, and those that are.

    Small sides of broken cuts are taken off one after the other, so that a wrong camera does not
    hide behind a wrong neighbour, nor is a right one blamed for it.
    """
    links = _Links.of(evidence, overlap)
    kept = evidence.registered.copy()
    allowed = max(1, int(MAX_ASTRAY * np.count_nonzero(kept)))
    while (side := _worst_side(links, kept)) is not None:
        count = np.count_nonzero(evidence.registered & ~kept) + np.count_nonzero(side)
        if links.share(side, kept) >= MIN_WEAK_LINK or count > allowed:
            return _described(evidence, links, side, kept), _astray(evidence, links, kept)
        kept &= ~side
    reason = f"no two parts have {MIN_MATCHES} verified matches between them"
    return WeakLink(None, reason, ((), ()), 0, 0, 0, 0.0), _astray(evidence, links, kept)


@dataclass(frozen=True)
class _Links:
    """What ties the images together, each [N, N] over all of them."""

    matches: Weights
    agreeing: Weights
    shared: Weights
    expected: Weights
    found: Weights

    @classmethod
    def of(cls, evidence: Evidence, overlap: Overlap) -> _Links:
        """Returns the matrices; matches of images without a camera are left out."""
        count, placed = len(evidence.names), evidence.placed
        pairs = evidence.pairs[placed]
        return cls(
            view_graph.weights(count, pairs, evidence.matches[placed]),
            view_graph.weights(count, pairs, evidence.agreeing[placed]),
            evidence.shared.astype(np.float64),
            overlap.expected,
            overlap.found)

    def among(self, rows: NDArray[np.int64]) -> _Links:
        """Returns the links of some images alone."""
        inner = np.ix_(rows, rows)
        return _Links(*(matrix[inner] for matrix in vars(self).values()))

    def share(self, side: Cut, kept: Cut) -> float:
        """Returns the share of the matches from a side to the rest that agree."""
        rest = np.ix_(side, kept & ~side)
        return float(self.agreeing[rest].sum() / max(self.matches[rest].sum(), 1.0))


def _worst_side(links: _Links, kept: Cut) -> Cut | None:
    """Returns the smaller side, [N], of the cut with the least share; None where none is told."""
    rows = np.flatnonzero(kept)
    if len(rows) < 2:
        return None
    inner = links.among(rows)
    alone = _shares(*(matrix.sum(axis=1) for matrix in (
        inner.agreeing, inner.matches, inner.expected, inner.found)))
    best, least = np.array([alone.argmin()]), alone.min()
    for order in _orders(inner):
        shares = _shares(*(view_graph.sweep(matrix, order) for matrix in (
            inner.agreeing, inner.matches, inner.expected, inner.found)))
        if shares.min() < least:
            best, least = order[:int(shares.argmin()) + 1], shares.min()
    if np.isinf(least):
        return None
    side = np.zeros_like(kept)
    side[rows[best]] = True
    return side if 2 * len(best) <= len(rows) else kept & ~side


def _orders(links: _Links) -> Iterator[Order]:
    """Yields orders whose sweeps may hold the worst cut.

    Parts that few points tie together are where a model breaks; the cut of most dispute is sought
    as well, because a break need not be where the points are fewest.
    """
    yield from view_graph.loose_orders(links.shared)
    yield from view_graph.disputed_orders(links.agreeing, links.matches)


def _shares(
    agreeing: NDArray[np.float64],  # [C]
    matches: NDArray[np.float64],  # [C]
    expected: NDArray[np.float64],  # [C]
    found: NDArray[np.float64],  # [C]
) -> NDArray[np.float64]:  # [C]
    """Returns the share of each cut, infinite where it says nothing.

    That is so where too few matches lie across, and where they disagree although the two sides show
    what they should: the matches are then those of places that look alike, and rightly left out.
    """
    shares = agreeing / np.maximum(matches, 1)
    alike = (shares < MIN_WEAK_LINK) & borne_out(expected, found)
    return np.where((matches >= MIN_MATCHES) & ~alike, shares, np.inf)


def _described(evidence: Evidence, links: _Links, side: Cut, kept: Cut) -> WeakLink:
    other = kept & ~side
    across = np.ix_(side, other)
    rows = np.flatnonzero(kept)
    return WeakLink(
        share=links.share(side, kept),
        reason="",
        sides=(_names(evidence, side), _names(evidence, other)),
        pairs=int(np.count_nonzero(links.matches[across])),
        matches=int(links.matches[across].sum()),
        points=int(links.shared[across].sum()),
        normalised_cut=view_graph.normalised_cut(links.shared[np.ix_(rows, rows)], side[rows]),
    )


def _astray(evidence: Evidence, links: _Links, kept: Cut) -> tuple[Astray, ...]:
    found = []
    for index in np.flatnonzero(evidence.registered & ~kept):
        matches = links.matches[index, kept].sum()
        share = links.agreeing[index, kept].sum() / max(matches, 1.0)
        found.append(Astray(evidence.names[index], float(share), int(matches)))
    return tuple(found)


def _names(evidence: Evidence, side: Cut) -> tuple[str, ...]:
    return tuple(evidence.names[index] for index in np.flatnonzero(side))
