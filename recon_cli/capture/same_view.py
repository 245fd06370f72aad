"""Which photos of a folder show one view: copies, and exposures of a bracket or an edited photo.

Of two exposures only the brightness differs, by a curve that rises, which isotonic regression fits.
A camera that moves a little changes more than any curve explains: brackets of -2 to +2 EV of 60
photos, by two tone curves, differ by less than .03 of their contrast, and the closest two of 680
photos of five walks by .084.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from scipy.stats import rankdata

from recon_cli.capture.frame_measures import measure_exposure, measure_sharpness
from recon_cli.capture.limits import CLIPPED_SHARE

SIDE = 64  # pixels of a reduced photo
# Distance of two signatures, or what a curve leaves, below which two photos are one view. A picture
# resaved, noisy or moved a little lies at .01 to .04 from itself; the closest two of 317 photos and
# frames at .08.
SAME_VIEW = 0.05
# A curve must explain as much of the distance: a camera that moves a little is no exposure.
EXPLAINED = 0.5
# Of 255: beyond these a sensor or a file keeps no differences, and no curve brings them back.
UNCLIPPED = (4, 252)
LEAST_COMMON = 0.05  # of the reduced photo, clipped in neither
# Correlation by rank of two reduced photos: only above it a curve is fitted, which takes a
# millisecond. Brackets of which three quarters are clipped reach .75.
LEAST_CORRELATION = 0.6
# Of brightness: a third of a stop, the smallest step of brackets, changes a signal by a tenth, a
# copy by a hundredth.
STEP = 0.05


@dataclass(frozen=True, eq=False)
class PhotoMeasures:
    """The measures of one stored photo; the first three by the functions of these names."""

    signature: NDArray[np.float32]
    exposure: tuple[float, float, float]
    sharpness: float
    green: NDArray[np.float64]  # [SIDE * SIDE], 0 to 255
    clipped: NDArray[np.bool_]  # [SIDE * SIDE]
    ranks: NDArray[np.float64]  # [SIDE * SIDE], of the green values, of mean 0 and length 1


def measure_photo(rgb: NDArray[np.uint8]) -> PhotoMeasures:
    """Returns the measures of a photo, [H, W, 3], that the selection needs."""
    gray = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    green = rgb[..., 1]  # not a sum of channels, of which each has its own curve and limit
    beyond = (green <= UNCLIPPED[0]) | (green >= UNCLIPPED[1])
    small, share = (
        cv2.resize(each.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA).ravel()
        for each in (green, beyond))
    ranks = rankdata(np.round(small))
    ranks -= ranks.mean()
    return PhotoMeasures(
        signature(gray), measure_exposure(gray), measure_sharpness(gray),
        np.asarray(small, np.float64), np.asarray(share > CLIPPED_SHARE),
        ranks / (np.linalg.norm(ranks) or 1.0))


def signature(gray: NDArray[np.uint8]) -> NDArray[np.float32]:  # [SIDE * SIDE]
    """Returns a picture [H, W] reduced by area, without its mean and of length 1; zero if flat."""
    small = cv2.resize(gray, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    small -= small.mean()
    length = float(np.linalg.norm(small))
    return np.asarray(small / length if length else small, np.float32)


def is_same_view(first: PhotoMeasures, second: PhotoMeasures) -> bool:
    """Returns whether two photos are one view, maybe in two exposures; a flat one is like none."""
    if not (first.signature.any() and second.signature.any()):
        return False
    distance = float(np.linalg.norm(first.signature - second.signature))
    return distance < SAME_VIEW or _differ_in_exposure(first, second, distance)


def _differ_in_exposure(first: PhotoMeasures, second: PhotoMeasures, distance: float) -> bool:
    if first.ranks @ second.ranks < LEAST_CORRELATION:
        return False
    left = measure_difference(first, second)
    return left < SAME_VIEW and left < (1 - EXPLAINED) * distance


def measure_difference(first: PhotoMeasures, second: PhotoMeasures) -> float:
    """Returns what a curve of brightness leaves of the difference, as a share of the contrast.

    It is 1 for photos that have nothing in common, or share too little that is not clipped.
    """
    common = ~(first.clipped | second.clipped)
    if common.mean() < LEAST_COMMON:
        return 1.0
    start, end = first.green[common], second.green[common]
    return min(_fit_curve(start, end), _fit_curve(end, start))


def _fit_curve(start: NDArray[np.float64], end: NDArray[np.float64]) -> float:
    """Returns the contrast of `end` that no rising curve of `start` explains, as a share."""
    ordered = end[np.argsort(start, kind="stable")]
    contrast = float(np.linalg.norm(end - end.mean()))
    left = float(np.linalg.norm(ordered - isotonic_regression(ordered).x))
    return left / contrast if contrast else 1.0


def compare_brightness(first: PhotoMeasures, second: PhotoMeasures) -> int:
    """Returns 1 where the first of two photos of a view is the brighter one, -1 for the second."""
    one, other = float(np.median(first.green)), float(np.median(second.green))
    return 0 if abs(one - other) <= STEP * max(one, other) else 1 if one > other else -1


def find_repeats(photos: Sequence[PhotoMeasures]) -> dict[int, int]:
    """Returns for each redundant photo the one that replaces it, by index.

    Of copies the sharpest remains, of a bracket the middle exposure, of two exposures the one that
    is less clipped.
    """
    same: dict[int, list[int]] = {index: [] for index in range(len(photos))}
    for first, second in combinations(same, 2):
        if is_same_view(photos[first], photos[second]):
            same[first].append(second)
            same[second].append(first)

    def preference(index: int) -> tuple[int, int, float]:
        photo = photos[index]
        off_middle = abs(sum(compare_brightness(photo, photos[other]) for other in same[index]))
        return off_middle, int(photo.clipped.sum()) * (off_middle > 0), -photo.sharpness

    redundant: dict[int, int] = {}
    unlike: list[int] = []
    for index in sorted(same, key=preference):
        original = next((other for other in unlike if other in same[index]), None)
        if original is None:
            unlike.append(index)
        else:
            redundant[index] = original
    return dict(sorted(redundant.items()))
