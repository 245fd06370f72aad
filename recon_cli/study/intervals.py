"""Means over seeds and paired intervals of differences."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from scipy import stats

CONFIDENCE = 0.95


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
