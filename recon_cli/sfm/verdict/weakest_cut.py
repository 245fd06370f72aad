"""Where a model is most likely broken: the cut across which its points do not hold together.

A mapper that goes wrong at one frame builds two good halves and places them wrongly to each other,
with a small reprojection error over what it kept. The matches across the break show it: each half
has triangulated its own points, so the two keypoints of a match show two points in place of one.

Where few matches tie two halves together, the mapper drops those that contradict it, and the rest
show the same points even in a wrong model. So the cameras must also explain most of the matches.

Places that look alike are matched as well, and rightly do not show the same points. So only the
strongest ties count: of each image the few that it has most matches with, and, where the order of
the images is known, those next to each other. The median of the pairs across a cut bears single
mistakes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.matches import MIN_PAIR_INLIERS
from recon_cli.sfm.limits import MAX_OUTLIERS, MIN_EXPLAINED, MIN_ONE_POINT, MIN_POSE_INLIERS
from recon_cli.sfm.verdict import view_graph
from recon_cli.sfm.verdict.evidence import MatchEvidence
from recon_cli.sfm.verdict.view_graph import Cut, Weights
from recon_cli.workspace.json_record import JsonRecord

# Images that each one has most matches with.
STRONGEST = 5
# Of the ties of a wrong camera so many at least contradict it; beside a break it is half of them.
WRONG = 0.75
# Images that stand at most so many apart in their order are next to each other.
REACH = 2


@dataclass(frozen=True)
class WeakestCut(JsonRecord):
    """The cut through a model across which matches least show the same points."""

    # Of the matches of a pair of images across, the share that shows one point of the model, where
    # their keypoints show any: the median of the pairs that count; None if unknown.
    share: float | None
    # Of the matches of those pairs, the share that the cameras explain: of all together or the
    # median, whichever is more, since many weak pairs or a few strong ones may only look alike;
    # None if they are few.
    explained: float | None
    reason: str  # why it is unknown; empty otherwise
    sides: tuple[tuple[str, ...], tuple[str, ...]]  # names of the images, the smaller side first
    pairs: int  # verified, across
    matches: int  # verified, across
    points: int  # of the model that images of both sides see, counted for every pair of them
    normalised_cut: float  # points across over those of the lighter side, 0 (apart) to 1


@dataclass(frozen=True)
class OutlierCamera(JsonRecord):
    """A camera that the image's own matches contradict."""

    name: str
    share: float  # of its matches with cameras that are not outliers, those that agree
    matches: int  # with such cameras
    rival: str  # of those, the one that contradicts it by most matches; empty without any
    joined: float | None  # of what both show, the share that is one point in both

    @property
    def reason(self) -> str:
        """What it contradicts, in words."""
        text = f"{self.share:.0%} of its {self.matches} matches agree with its pose"
        if self.joined is None:
            return text
        return f"{text}, and only {self.joined:.0%} of those with {self.rival} show one point"


def find_weakest_cut(
    evidence: MatchEvidence, order: NDArray[np.int64] | None = None
) -> tuple[WeakestCut, tuple[OutlierCamera, ...]]:
    """Returns the weakest cut of the cameras without the outliers, and the outliers.

    `order` are the images with a camera as they were taken, where that is known. Wrong cameras and
    other small sides of broken cuts are removed one by one, so that none hides behind another.
    """
    links = _Links.from_evidence(evidence)
    allowed = max(1, int(MAX_OUTLIERS * np.count_nonzero(evidence.registered)))
    inliers = _drop_wrong_cameras(links, evidence.registered, allowed)
    while (weakest := _weakest_side(links, inliers, order)) is not None:
        side, strength = weakest
        count = np.count_nonzero(evidence.registered & ~inliers) + np.count_nonzero(side)
        if strength.holds or count > allowed or _agrees(links, side, inliers):
            return (_cut(evidence, links, side, inliers, strength),
                    _outliers(evidence, links, inliers))
        inliers &= ~side
    reason = (f"no two parts have a pair of images with {MIN_PAIR_INLIERS} matched points between "
              "them")
    return (WeakestCut(None, None, reason, ((), ()), 0, 0, 0, 0.0),
            _outliers(evidence, links, inliers))


def _agrees(links: _Links, side: Cut, inliers: Cut) -> bool:
    """Returns whether the cameras of a side stand where most matches with the others say.

    Then they are a part of the walk that does not fit as a whole, and not outliers.
    """
    across = np.ix_(side, inliers & ~side)
    matches = links.matches[across].sum()
    agreeing = links.agreeing[across].sum()
    return bool(matches >= MIN_POSE_INLIERS and agreeing >= MIN_ONE_POINT * matches)


@dataclass(frozen=True)
class _Strength:
    """How well matches across a cut agree with the model; infinite where too few tell."""

    share: float  # of a pair's matches, those that show one point: the median
    explained: float  # share of the matches that the cameras explain, as in WeakestCut

    @property
    def order(self) -> tuple[bool, float]:
        """Least for the weakest: one that is torn, then the lesser of the two over their bounds."""
        share = self.share / MIN_ONE_POINT
        return share >= 1, min(share, self.explained / MIN_EXPLAINED)

    @property
    def holds(self) -> bool:
        """Whether both reach their bounds."""
        return self.order[1] >= 1


@dataclass(frozen=True)
class _Links:
    """Weights between the images, each [N, N] over all of them."""

    matches: Weights
    agreeing: Weights
    explained: Weights
    shared: Weights
    shares: Weights  # of the matches, those that show one point; NaN where too few show any

    @classmethod
    def from_evidence(cls, evidence: MatchEvidence) -> _Links:
        """Returns the matrices; matches of images without a camera are left out."""
        count, placed = len(evidence.names), evidence.placed
        pairs = evidence.pairs[placed]
        matches, agreeing, explained, traced, joined = (
            view_graph.weights(count, pairs, values[placed]) for values in (
                evidence.matches, evidence.agreeing, evidence.explained, evidence.traced,
                evidence.joined))
        shares = np.divide(
            joined, traced, out=np.full_like(traced, np.nan), where=traced >= MIN_PAIR_INLIERS)
        # A camera far from where it belongs sees no points at all; its matches speak all the same.
        blind = evidence.points < MIN_PAIR_INLIERS
        shares[(blind[:, None] | blind) & (matches >= MIN_POSE_INLIERS)] = 0.0
        return cls(matches, agreeing, explained, evidence.shared.astype(np.float64), shares)


def _drop_wrong_cameras(links: _Links, registered: Cut, allowed: int) -> Cut:  # [N]
    """Returns the images without those that nearly all of their strongest ties contradict.

    Those that share no point with the others go first. Returns all where there are too many: then a
    part of the model is wrong.
    """
    inliers = registered.copy()
    rows = np.flatnonzero(registered)
    for piece in view_graph.components(links.shared[np.ix_(rows, rows)])[1:]:
        inliers[rows[piece]] = False
    for _ in range(allowed + 1):
        if np.count_nonzero(registered & ~inliers) > allowed:
            break
        rows = np.flatnonzero(inliers)
        inner = np.ix_(rows, rows)
        ties = view_graph.strongest_ties(links.matches[inner], STRONGEST)
        shares = [_quantile(row[tied], WRONG)
                  for row, tied in zip(links.shares[inner], ties, strict=True)]
        worst = int(np.argmin(shares)) if shares else 0
        if not shares or shares[worst] >= MIN_ONE_POINT:
            return inliers
        inliers[rows[worst]] = False
    return registered.copy()


def _quantile(shares: NDArray[np.float64], quantile: float) -> float:
    """Returns a quantile of those that are known, infinity without any."""
    known = shares[~np.isnan(shares)]
    return float(np.quantile(known, quantile)) if len(known) else np.inf


def _weakest_side(
    links: _Links, inliers: Cut, order: NDArray[np.int64] | None
) -> tuple[Cut, _Strength] | None:
    """Returns the smaller side, [N], of the weakest cut; None where too few matches tell of any."""
    rows = np.flatnonzero(inliers)
    if len(rows) < 2:
        return None
    inner = np.ix_(rows, rows)
    matches, explained, shares = (
        weights[inner] for weights in (links.matches, links.explained, links.shares))
    best, least = None, _Strength(np.inf, np.inf)
    for cut, pairs in _cuts(matches, None if order is None else np.searchsorted(
            rows, order[inliers[order]])):
        strength = _Strength(
            _quantile(shares[pairs], 0.5), _explained_share(matches[pairs], explained[pairs]))
        if strength.order < least.order:
            best, least = cut, strength
    if best is None:
        return None
    side = np.zeros_like(inliers)
    side[rows[best if 2 * np.count_nonzero(best) <= len(rows) else ~best]] = True
    return side, least


def _explained_share(
    matches: NDArray[np.float64], explained: NDArray[np.float64]  # [P], [P]
) -> float:
    """Returns the share of matches of pairs that is explained; infinity where they are too few."""
    some = matches > 0
    if np.count_nonzero(some) < 2 or matches.sum() < MIN_POSE_INLIERS:
        return np.inf
    return float(max(
        explained.sum() / matches.sum(), np.median(explained[some] / matches[some])))


def _cuts(
    matches: Weights, order: NDArray[np.int64] | None
) -> Iterator[tuple[Cut, tuple[NDArray[np.int64], NDArray[np.int64]]]]:
    """Yields cuts, [N], and the pairs of images that count across each, [P] and [P]."""
    first, second = np.nonzero(np.triu(view_graph.strongest_ties(matches, STRONGEST)))
    for cut in view_graph.tree_cuts(view_graph.spanning_forest(matches)):
        across = cut[first] != cut[second]
        yield cut, (first[across], second[across])
    if order is None:
        return
    place = np.argsort(order)
    first, second = np.nonzero(np.triu(np.abs(place[:, None] - place) <= REACH, 1))
    for count in range(1, len(order)):
        cut = place < count
        across = cut[first] != cut[second]
        yield cut, (first[across], second[across])


def _cut(
    evidence: MatchEvidence, links: _Links, side: Cut, inliers: Cut, strength: _Strength
) -> WeakestCut:
    other = inliers & ~side
    across = np.ix_(side, other)
    rows = np.flatnonzero(inliers)
    names = np.array(evidence.names)
    return WeakestCut(
        share=_finite(strength.share), explained=_finite(strength.explained), reason="",
        sides=(tuple(names[side].tolist()), tuple(names[other].tolist())),
        pairs=int(np.count_nonzero(links.matches[across])),
        matches=int(links.matches[across].sum()), points=int(links.shared[across].sum()),
        normalised_cut=view_graph.conductance(links.shared[np.ix_(rows, rows)], side[rows]))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _outliers(evidence: MatchEvidence, links: _Links, inliers: Cut) -> tuple[OutlierCamera, ...]:
    outliers = []
    others = np.flatnonzero(inliers)
    for index in np.flatnonzero(evidence.registered & ~inliers):
        matches = links.matches[index, others]
        share = links.agreeing[index, others].sum() / max(matches.sum(), 1.0)
        wrong = np.where(links.shares[index, others] < MIN_ONE_POINT, matches, 0)
        worst = int(others[wrong.argmax()]) if wrong.any() else None
        outliers.append(OutlierCamera(
            evidence.names[index], float(share), int(matches.sum()),
            "" if worst is None else evidence.names[worst],
            None if worst is None else float(links.shares[index, worst])))
    return tuple(outliers)
