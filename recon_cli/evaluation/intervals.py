"""Spreads over seeds, and 95% intervals of paired differences."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon_cli.workspace.summaries import JsonRecord

CONFIDENCE = 0.95
_DRAWS = 10_000  # the ends of the interval then move by about 1% of its width from seed to seed


@dataclass(frozen=True)
class Interval(JsonRecord):
    """A mean difference and the ends of its interval; both None where there is one pair only."""

    mean: float
    low: float | None
    high: float | None

    @property
    def verdict(self) -> str:
        """The result of an interval over seeds: higher, lower, no difference shown, one seed."""
        if self.low is None or self.high is None:
            return "one seed"
        if self.low > 0:
            return "higher"
        return "lower" if self.high < 0 else "no difference shown"

    def text(self, form: str) -> str:
        """Returns an interval over views in words, its numbers in a format such as "+.2f"."""
        if self.low is None or self.high is None:
            return f"{self.mean:{form}} (one view)"
        return f"{self.mean:{form}} [{self.low:{form}}, {self.high:{form}}]"


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation (n - 1) of a figure over seeds; no deviation for one seed."""

    mean: float
    deviation: float | None

    @staticmethod
    def from_values(values: Sequence[float]) -> Spread:
        """Returns the spread of some values, at least one."""
        deviation = statistics.stdev(values) if len(values) > 1 else None
        return Spread(statistics.fmean(values), deviation)

    def text(self, form: str) -> str:
        """Returns mean and deviation in a format such as ".2f"."""
        if self.deviation is None:
            return f"{self.mean:{form}}"
        return f"{self.mean:{form}} ± {self.deviation:{form}}"


def paired_bootstrap(ours: Sequence[float], theirs: Sequence[float], *, seed: int = 0) -> Interval:
    """Returns the mean of ours - theirs with its percentile interval (bootstrap, Efron 1979).

    Views are drawn with replacement, both models' scores of a view together. The interval is about
    other views of the same scene, not other scenes or seeds; similar views make it too narrow.
    """
    pairs = np.array(ours, np.float64) - np.array(theirs, np.float64)
    mean = float(pairs.mean())
    if len(pairs) < 2:
        return Interval(mean, None, None)
    draws = np.random.default_rng(seed).integers(0, len(pairs), (_DRAWS, len(pairs)))
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(pairs[draws].mean(axis=1), (tail, 1 - tail))
    return Interval(mean, float(low), float(high))


def paired_t(ours: Sequence[float], theirs: Sequence[float]) -> Interval:
    """Returns the mean of ours - theirs with its t interval (Student 1908), paired by seed.

    The interval is about other seeds on the same scenes, not about other scenes.
    """
    pairs = [a - b for a, b in zip(ours, theirs, strict=True)]
    mean = statistics.fmean(pairs)
    if len(pairs) < 2:
        return Interval(mean, None, None)
    from scipy.special import stdtrit  # takes half a second; scipy.stats another one

    quantile = float(stdtrit(len(pairs) - 1, (1 + CONFIDENCE) / 2))
    half = quantile * statistics.stdev(pairs) / math.sqrt(len(pairs))
    return Interval(mean, mean - half, mean + half)
