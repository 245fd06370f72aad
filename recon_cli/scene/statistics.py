"""Statistics that outliers leave alone, and how many samples stand for all.

Limits that several packages mean alike stand here, each once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

OUTLIER_SIGMAS = 3.0  # standard deviations beyond which a value contradicts the others
# Points of a cloud that stand for all: for a first search, and for a quantile known to a percent.
COARSE_SAMPLE, FINE_SAMPLE = 4_000, 20_000
# Views of a thing: of fewer one may be wrong; and those that a judgement needs, as two rays meet in
# whatever way, and two views agree on much that is wrong.
LEAST_WITNESSES, MIN_OBSERVATIONS = 2, 3
LEAST_SAMPLE = 100  # points, of which fewer decide nothing
# Samples that two views must share: their median is known to a fifth of their spread.
LEAST_SHARED = 40
UNCLIPPED = (12, 243)  # of 255, of a mean over some pixels, of which some may be clipped beyond
REFIT_ROUNDS = 4  # of weights, of a fit that outliers are to leave alone
MOST_MAPS = 100  # depth maps that surfaces are looked up in, evenly spread
ROUNDING = 1e-6  # relative: what float32 leaves of a value, and two machines may differ by


def at_least(bound: tuple[float, float], whole: float) -> float:
    """Returns the larger of the two that `bound` gives: a number, and a multiple of `whole`."""
    least, share = bound
    return max(least, share * whole)


def robust_sigma(
    deviations: NDArray[np.floating], weights: NDArray[np.floating] | None = None
) -> float:
    """Returns the standard deviation of normal deviations [N] from 0 by their median size.

    `weights` [N] count some more than others. The factor is 1 / Phi^-1(3/4).
    """
    size = np.abs(deviations)
    if weights is None:
        return 1.4826 * float(np.median(size))
    order = np.argsort(size)
    cumulated = np.cumsum(weights[order])
    return 1.4826 * float(size[order][np.searchsorted(cumulated, cumulated[-1] / 2)])
