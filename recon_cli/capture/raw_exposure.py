"""The relative exposures of the photos of one scene, in stops (EV).

EXIF gives the exposure precisely enough, but converters lose it or copy it wrongly. The brightness
of shared points in overlapping photos gives it too, with noise that adds up along a chain of
photos. So EXIF is used unless the pixels clearly contradict it, and pixels replace missing values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recon_cli.capture.limits import MOST_FEATURES
from recon_cli.scene.matches import MAX_RATIO
from recon_cli.scene.statistics import FINE_SAMPLE, LEAST_WITNESSES

# Standard deviation of the difference that a pair gives, over 77 pairs of 40 photos of a desk.
PAIR_EV = 0.022
# Beyond this, EXIF is rejected. Light that changed by itself (a phone's own exposure left in
# the pixels) bent pairs by 0.25 EV (standard deviation); a wrong EXIF is off by a stop and more.
DOUBT_EV = 0.5
LOOSE_EV = 3.0  # keeps photos of unknown exposure near the others
REACH = 4  # each photo is compared with so many that follow
MIN_DISTINCT = 20  # below this, repeated things can agree on a geometry by chance
EPIPOLAR_PIXELS = 1.5  # of the small view: room for a lens that is not undistorted
# Between the quartiles of a pair's ratios: at most 0.43 EV over 40 pairs of a rendered room that
# overlap well, at least 0.6 EV, mostly above 1, over the 14 whose matches were chance.
AGREED_EV = 0.5
# Linear values, as shares of saturation, between which noise and clipping do not distort a ratio.
USABLE = (0.004, 0.9)

Pairs = Mapping[tuple[int, int], float]  # by how many EV the second photo is brighter


@dataclass(frozen=True)
class RawMeasures:
    """Measures of a small linear view of a photo; the views themselves would fill the memory."""

    points: NDArray[np.float32]  # [K, 2], its key points in pixels of the view
    descriptors: NDArray[np.uint8]  # [K, 128], SIFT as integers
    levels: NDArray[np.float64]  # [K], log2 of the mean green around, NaN if clipped or too dark
    brightest: NDArray[np.float32]  # [P], highest channel, 1 for saturation, infinite if clipped

    @property
    def clipped_share(self) -> float:
        """The share of its pixels that are clipped."""
        return float(np.isinf(self.brightest).mean())


def measure_view(
    linear: NDArray[np.float32],  # [h, w, 3], white-balanced sensor values, 1 for saturation
    clipped: NDArray[np.bool_],  # [h, w], where a channel is saturated
) -> RawMeasures:
    """Returns the measures of a view."""
    keys, sift = cv2.SIFT.create(nfeatures=MOST_FEATURES).detectAndCompute(_visible(linear), None)
    descriptors = np.empty((0, 128), np.uint8) if sift is None else sift.astype(np.uint8)
    brightest = np.where(clipped, np.inf, linear.max(axis=2)).astype(np.float32).ravel()
    sample = np.linspace(0, len(brightest) - 1, min(FINE_SAMPLE, len(brightest))).astype(int)
    points = np.array([key.pt for key in keys], np.float32).reshape(-1, 2)
    return RawMeasures(points, descriptors, _levels(linear, clipped, points), brightest[sample])


def nominal_ev(seconds: float, iso: float) -> float | None:
    """Returns log2 of seconds x ISO, the exposure at one f-number; None where unknown."""
    if not all(math.isfinite(value) and value > 0 for value in (seconds, iso)):
        return None
    return math.log2(seconds * iso)


def exposures(
    photos: Sequence[RawMeasures], nominal: Sequence[float | None]
) -> NDArray[np.float64]:
    """Returns the exposure of each photo in EV, [N], 0 for the median photo.

    `photos` are in the order of taking; `nominal` are the exposures by EXIF in EV, or None.
    """
    pairs = _compare_pairs(photos)
    ev = complete_exposures(drop_contradicted(nominal, pairs), pairs)
    return ev - np.median(ev)


def drop_contradicted(nominal: Sequence[float | None], pairs: Pairs) -> list[float | None]:
    """Returns the exposures by EXIF without those that the pixels contradict, the worst first."""
    known = list(nominal)
    while True:
        errors: dict[int, list[float]] = {}  # EXIF of a photo minus that by each of its pairs
        for (a, b), apart in pairs.items():
            dark, bright = known[a], known[b]
            if dark is not None and bright is not None:
                errors.setdefault(b, []).append(bright - dark - apart)
                errors.setdefault(a, []).append(apart - bright + dark)
        doubts = {
            photo: abs(float(np.median(off)))
            for photo, off in errors.items() if len(off) >= LEAST_WITNESSES}
        worst = max(doubts, key=doubts.__getitem__, default=None)
        if worst is None or doubts[worst] < DOUBT_EV:
            return known
        known[worst] = None


def complete_exposures(known: Sequence[float | None], pairs: Pairs) -> NDArray[np.float64]:
    """Returns all exposures in EV, [N]: the known ones, and the others from the pairs.

    The loss is quadratic up to `PAIR_EV` and linear above, so that one wrong pair is outvoted.
    """
    values = [ev for ev in known if ev is not None]
    middle = np.median(values) if values else 0.0
    ev = np.array([middle if own is None else own for own in known], np.float64)
    column = {photo: k for k, photo in enumerate(p for p, own in enumerate(known) if own is None)}
    if not column:
        return ev
    useful = [pair for pair in pairs if column.keys() & set(pair)]
    rows = np.zeros((len(useful), len(column)))
    wanted = np.empty(len(useful))
    for row, (a, b) in enumerate(useful):
        wanted[row] = pairs[a, b] - (ev[b] if b not in column else 0.0) + (
            ev[a] if a not in column else 0.0)
        for photo, sign in ((a, -1.0), (b, 1.0)):
            if photo in column:
                rows[row, column[photo]] = sign
    free = list(column)
    matrix = np.vstack([rows / PAIR_EV, np.eye(len(free)) / LOOSE_EV])
    target = np.concatenate([wanted / PAIR_EV, ev[free] / LOOSE_EV])
    ev[free] = least_squares(
        # a copy: scipy before 1.16 weighs in place what jac returns
        lambda x: matrix @ x - target, ev[free], jac=lambda _: matrix.copy(), loss="soft_l1").x
    return ev


def _compare_pairs(photos: Sequence[RawMeasures]) -> Pairs:
    """Returns by how many EV the second photo of a pair is brighter, where both overlap."""
    differences: dict[tuple[int, int], float] = {}
    for a in range(len(photos)):
        for b in range(a + 1, min(a + 1 + REACH, len(photos))):
            at, matched = _matches(photos[a], photos[b])
            brighter = photos[b].levels[matched] - photos[a].levels[at]
            brighter = brighter[np.isfinite(brighter)]
            if len(brighter) < MIN_DISTINCT:
                continue
            low, middle, high = np.quantile(brighter, [0.25, 0.5, 0.75])
            if high - low <= AGREED_EV:
                differences[a, b] = float(middle)
    return differences


def _matches(
    first: RawMeasures, second: RawMeasures
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns indices of matches in both photos, [M] each, that fit one epipolar geometry."""
    none = np.empty(0, np.int64), np.empty(0, np.int64)
    if len(first.points) < MIN_DISTINCT or len(second.points) < MIN_DISTINCT:
        return none
    nearest = cv2.BFMatcher().knnMatch(
        first.descriptors.astype(np.float32), second.descriptors.astype(np.float32), k=2)
    distinct = [
        (m.queryIdx, m.trainIdx) for m, n in nearest if m.distance < MAX_RATIO * n.distance]
    if len(distinct) < MIN_DISTINCT:
        return none
    at, matched = np.array(distinct, np.int64).T
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
    return np.asarray(np.round(255 * np.clip(gray / bright, 0, 1) ** (1 / 2.2)).astype(np.uint8))


def _levels(
    linear: NDArray[np.float32], clipped: NDArray[np.bool_], points: NDArray[np.float32]
) -> NDArray[np.float64]:
    size = (5, 5)  # about the inner cell of the smallest SIFT descriptor
    green = cv2.blur(np.ascontiguousarray(linear[..., 1]), size)
    near_clipped = cv2.dilate(clipped.astype(np.uint8), np.ones(size, np.uint8)) > 0
    at = points.round().astype(int)
    x, y = (np.clip(at[:, k], 0, green.shape[1 - k] - 1) for k in (0, 1))
    value = green[y, x].astype(np.float64)
    usable = (value > USABLE[0]) & (value < USABLE[1]) & ~near_clipped[y, x]
    return np.where(usable, np.log2(np.maximum(value, USABLE[0])), np.nan)
