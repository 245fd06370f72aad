"""How brightly photos of one scene were exposed against each other, in stops (EV).

EXIF tells the exposure exactly enough, but converters lose it and copy it wrongly. What overlapping
photos show of the same points tells it too, with noise that adds up along a chain of photos. So
EXIF is believed unless the pixels clearly contradict, and pixels fill in for what is then missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

# How far the difference that a pair shows is off: the standard deviation was 0.022 EV over 77 pairs
# of 40 photos of a desk, one exposure, made brighter and darker by known amounts.
PAIR_EV = 0.022
# Beyond this, EXIF is not believed. Light that changed by itself (a phone's own exposure left in
# the pixels) bent pairs by 0.25 EV (standard deviation); a wrong EXIF is off by a stop and more.
DOUBT_EV = 0.5
MIN_WITNESSES = 2  # pairs that it takes to doubt an EXIF
LOOSE_EV = 3.0  # holds photos of which nothing is known near the others
REACH = 4  # photos are compared with so many that follow
FEATURES = 1500  # the strongest: pairs of neighbours then share hundreds, at 20 ms a pair
PIXELS_KEPT = 20_000  # of each photo, enough for a percentile
MIN_MATCHES = 20  # below this, repeated things can agree on a geometry by chance
EPIPOLAR_PIXELS = 1.5  # of the small view: room for a lens that is not undistorted
# Between the quartiles of a pair's ratios: at most 0.43 EV over 40 pairs of a rendered room that
# overlap well, at least 0.6 EV, mostly above 1, over the 14 whose matches were chance.
AGREED_EV = 0.5
RATIO = 0.8  # Lowe, IJCV 2004, section 7.1
# Linear values, as shares of saturation, at which noise and clipping do not bend a ratio.
DARK, BRIGHT = 0.004, 0.9

Pairs = Mapping[tuple[int, int], float]  # by how many EV the second photo is brighter


@dataclass(frozen=True)
class Look:
    """What is kept of a small linear view of a photo; the view itself would fill the memory.

    Attributes:
        points: its K key points in pixels of the view, [K, 2].
        descriptors: their SIFT, whole numbers, [K, 128].
        levels: log2 of the mean green around each, [K], NaN where that is no measure.
        brightest: the highest channel of each pixel, 1 for saturation, infinite where clipped, [P].
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    levels: NDArray[np.float64]
    brightest: NDArray[np.float32]

    @property
    def clipped_share(self) -> float:
        """The share of its pixels that are clipped."""
        return float(np.isinf(self.brightest).mean())


def look_at(linear: NDArray[np.float32], clipped: NDArray[np.bool_]) -> Look:
    """Returns what is kept of a view.

    Args:
        linear: white-balanced sensor values, 1 for saturation, [h, w, 3].
        clipped: where a channel is saturated, [h, w].
    """
    keys, found = cv2.SIFT.create(nfeatures=FEATURES).detectAndCompute(_visible(linear), None)
    descriptors = np.empty((0, 128), np.uint8) if found is None else found.astype(np.uint8)
    brightest = np.where(clipped, np.inf, linear.max(axis=2)).astype(np.float32).ravel()
    kept = np.linspace(0, len(brightest) - 1, min(PIXELS_KEPT, len(brightest))).astype(int)
    points = np.array([key.pt for key in keys], np.float32).reshape(-1, 2)
    return Look(points, descriptors, _levels(linear, clipped, points), brightest[kept])


def nominal_ev(seconds: float, iso: float, f_number: float | None) -> float | None:
    """Returns log2 of what a shot collects, seconds x ISO / f-number^2; None where unknown."""
    values = (seconds, iso, 1.0 if f_number is None else f_number)
    if not all(math.isfinite(value) and value > 0 for value in values):
        return None
    return math.log2(values[0] * values[1] / values[2] ** 2)


def exposures(looks: Sequence[Look], nominal: Sequence[float | None]) -> NDArray[np.float64]:
    """Returns the exposure of each photo in EV, [N], 0 for the median photo.

    Args:
        looks: at the photos, in the order of taking: neighbours overlap.
        nominal: exposures by EXIF in EV, None where unknown.
    """
    pairs = _pairs(looks)
    found = completed(believed(nominal, pairs), pairs)
    return found - np.median(found)


def believed(nominal: Sequence[float | None], pairs: Pairs) -> list[float | None]:
    """Returns the exposures by EXIF without those that the pixels contradict, the worst first."""
    kept = list(nominal)
    while True:
        doubts = {
            photo: abs(float(np.median(off)))
            for photo, off in _contradictions(kept, pairs).items() if len(off) >= MIN_WITNESSES}
        worst = max(doubts, key=doubts.__getitem__, default=None)
        if worst is None or doubts[worst] < DOUBT_EV:
            return kept
        kept[worst] = None


def _contradictions(kept: Sequence[float | None], pairs: Pairs) -> dict[int, list[float]]:
    """Returns by how much EXIF makes each photo too bright, by each pair that tells."""
    found: dict[int, list[float]] = {}
    for (a, b), apart in pairs.items():
        dark, bright = kept[a], kept[b]
        if dark is not None and bright is not None:
            found.setdefault(b, []).append(bright - dark - apart)
            found.setdefault(a, []).append(apart - bright + dark)
    return found


def completed(known: Sequence[float | None], pairs: Pairs) -> NDArray[np.float64]:
    """Returns all exposures in EV, [N]: those known, and the others as the pairs want them.

    Least squares at first, absolute values from `PAIR_EV` on, so that one wrong pair is outvoted.
    """
    given = [ev for ev in known if ev is not None]
    ev = np.array([np.median(given) if given else 0.0] * len(known))
    for photo, own in enumerate(known):
        ev[photo] = ev[photo] if own is None else own
    column = {photo: k for k, photo in enumerate(p for p, own in enumerate(known) if own is None)}
    if not column:
        return ev
    told = [pair for pair in pairs if column.keys() & set(pair)]
    rows = np.zeros((len(told), len(column)))
    wanted = np.empty(len(told))
    for row, (a, b) in enumerate(told):
        wanted[row] = pairs[a, b] - (ev[b] if b not in column else 0.0) + (
            ev[a] if a not in column else 0.0)
        for photo, sign in ((a, -1.0), (b, 1.0)):
            if photo in column:
                rows[row, column[photo]] = sign
    free = list(column)
    matrix = np.vstack([rows / PAIR_EV, np.eye(len(free)) / LOOSE_EV])
    target = np.concatenate([wanted / PAIR_EV, ev[free] / LOOSE_EV])
    ev[free] = least_squares(
        lambda x: matrix @ x - target, ev[free], jac=lambda _: matrix, loss="soft_l1").x
    return ev


def _pairs(looks: Sequence[Look]) -> Pairs:
    """Returns by how many EV the second photo of a pair is brighter, where both overlap."""
    found: dict[tuple[int, int], float] = {}
    for a in range(len(looks)):
        for b in range(a + 1, min(a + 1 + REACH, len(looks))):
            at, matched = _matches(looks[a], looks[b])
            brighter = looks[b].levels[matched] - looks[a].levels[at]
            brighter = brighter[np.isfinite(brighter)]
            if len(brighter) < MIN_MATCHES:
                continue
            low, middle, high = np.quantile(brighter, [0.25, 0.5, 0.75])
            if high - low <= AGREED_EV:
                found[a, b] = float(middle)
    return found


def _matches(first: Look, second: Look) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns which key points show one point, as places in both, [M] each.

    Lowe's ratio alone takes repeated things for one, and a wrong pair costs more than a missing
    one; what also obeys one epipolar geometry hardly ever is wrong.
    """
    none = np.empty(0, np.int64), np.empty(0, np.int64)
    if len(first.points) < MIN_MATCHES or len(second.points) < MIN_MATCHES:
        return none
    nearest = cv2.BFMatcher().knnMatch(
        first.descriptors.astype(np.float32), second.descriptors.astype(np.float32), k=2)
    kept = [(m.queryIdx, m.trainIdx) for m, n in nearest if m.distance < RATIO * n.distance]
    if len(kept) < MIN_MATCHES:
        return none
    at, matched = np.array(kept, np.int64).T
    _, inliers = cv2.findFundamentalMat(
        first.points[at], second.points[matched], cv2.USAC_MAGSAC, EPIPOLAR_PIXELS, 0.999, 2000)
    if inliers is None:
        return none
    good = inliers.ravel() > 0
    return at[good], matched[good]


def _visible(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Returns a gray picture whose contrast does not depend on the exposure, [h, w]."""
    gray = linear.mean(axis=2)
    bright = max(float(np.percentile(gray, 99)), 1e-6)
    return np.asarray(
        np.round(255 * np.clip(gray / bright, 0, 1) ** (1 / 2.2)).astype(np.uint8))


def _levels(
    linear: NDArray[np.float32], clipped: NDArray[np.bool_], points: NDArray[np.float32]
) -> NDArray[np.float64]:
    size = (5, 5)  # about the inner cell of the smallest SIFT descriptor
    green = cv2.blur(np.ascontiguousarray(linear[..., 1]), size)
    near_clipped = cv2.dilate(clipped.astype(np.uint8), np.ones(size, np.uint8)) > 0
    at = points.round().astype(int)
    x, y = (np.clip(at[:, k], 0, green.shape[1 - k] - 1) for k in (0, 1))
    value = green[y, x].astype(np.float64)
    usable = (value > DARK) & (value < BRIGHT) & ~near_clipped[y, x]
    return np.where(usable, np.log2(np.maximum(value, DARK)), np.nan)
