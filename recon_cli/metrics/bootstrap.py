"""How sure the difference of two models is, from the views that both were scored on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95
_DRAWS = 10_000  # the ends of the interval then move by about 1% of its width from seed to seed


@dataclass(frozen=True)
class PairedDifference:
    """A mean difference and its interval.

    Attributes:
        mean: of the differences, view by view.
        low: lower end; None where there is one view only.
        high: upper end; None where there is one view only.
    """

    mean: float
    low: float | None
    high: float | None


def paired_bootstrap(
    ours: Sequence[float], theirs: Sequence[float], *, seed: int = 0
) -> PairedDifference:
    """Returns the mean of ours - theirs with its percentile interval at 95%.

    Views are drawn with replacement, both models' scores of a view together (Efron 1979). The
    interval speaks of other views of the same scene, and not of other scenes or other seeds; views
    of one walk resemble each other, so it is rather too narrow.

    Args:
        ours: a score by view.
        theirs: of the same views.
        seed: of the draws.
    """
    pairs = np.array(ours, np.float64) - np.array(theirs, np.float64)
    mean = float(pairs.mean())
    if len(pairs) < 2:
        return PairedDifference(mean, None, None)
    draws = np.random.default_rng(seed).integers(0, len(pairs), (_DRAWS, len(pairs)))
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(pairs[draws].mean(axis=1), (tail, 1 - tail))
    return PairedDifference(mean, float(low), float(high))
