"""Means over seeds and paired intervals of differences."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

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


@dataclass(frozen=True)
class Spread:
    """A figure over seeds.

    Attributes:
        mean: over the seeds.
        deviation: standard deviation of a sample (n - 1); None for one seed.
    """

    mean: float
    deviation: float | None


@dataclass(frozen=True)
class Difference:
    """How one arm differs from another, seed by seed.

    Attributes:
        mean: of the differences.
        low: lower end of the interval; None for one seed.
        high: upper end of the interval; None for one seed.
    """

    mean: float
    low: float | None
    high: float | None

    @property
    def shown(self) -> str:
        """What the interval shows: "higher", "lower", "no difference shown" or "one seed"."""
        if self.low is None or self.high is None:
            return "one seed"
        if self.low > 0:
            return "higher"
        return "lower" if self.high < 0 else "no difference shown"


def spread(values: Sequence[float]) -> Spread:
    """Returns mean and standard deviation of some values, at least one."""
    deviation = statistics.stdev(values) if len(values) > 1 else None
    return Spread(statistics.fmean(values), deviation)


def difference(ours: Sequence[float], theirs: Sequence[float]) -> Difference:
    """Returns the mean of ours - theirs with its t interval at 95%.

    The differences are paired: the same seed on both sides. (Student 1908, "The probable error of
    a mean".) The interval speaks of other seeds on the same scenes, not of other scenes.

    Args:
        ours: a figure by seed.
        theirs: the same seeds of the other arm.
    """
    pairs = [a - b for a, b in zip(ours, theirs, strict=True)]
    mean = statistics.fmean(pairs)
    if len(pairs) < 2:
        return Difference(mean, None, None)
    quantile = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(pairs) - 1))
    half = quantile * statistics.stdev(pairs) / math.sqrt(len(pairs))
    return Difference(mean, mean - half, mean + half)
