"""Timing that survives a busy machine: candidates in turn, medians, and the spread beside them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

# OpenMP's threads of the candidate before spin on for some milliseconds after their last work.
_SETTLE_SECONDS = 0.03

Samples = dict[str, list[float]]  # name of a part -> its milliseconds, round by round


@dataclass(frozen=True)
class Timing:
    """A measured time.

    Attributes:
        ms: median over the rounds.
        iqr_ms: from the first to the third quartile; 0 for a single round.
    """

    ms: float
    iqr_ms: float


def timing_of(samples: Sequence[float]) -> Timing:
    """Returns the median and the interquartile range of some milliseconds."""
    if not samples:
        raise ValueError("no samples")
    if len(samples) == 1:
        return Timing(samples[0], 0.0)
    first, middle, third = statistics.quantiles(samples, n=4, method="inclusive")
    return Timing(middle, third - first)


class Stopwatch:
    """Books the time between marks; waits for the device at each of them."""

    def __init__(self, device: str) -> None:
        self._device = device
        self.ms: dict[str, float] = {}
        self._last = self._now()

    def mark(self, name: str) -> None:
        """Books what has passed since the last mark under `name`."""
        now = self._now()
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now

    def _now(self) -> float:
        if self._device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()


def alternate(
    works: Mapping[str, Callable[[], Mapping[str, float]]],
    rounds: int,
    on_round: Callable[[], None],
) -> dict[str, Samples]:
    """Runs all candidates in turn, A B A B, and returns the samples of each.

    A slow minute then falls on all candidates alike. One round ahead is not counted: it compiles
    and warms the caches.

    Args:
        works: by name; each returns the milliseconds of its parts.
        rounds: counted runs of each.
        on_round: called after each round, that ahead included.
    """
    found: dict[str, Samples] = {name: {} for name in works}
    for number in range(rounds + 1):
        for name, work in works.items():
            time.sleep(_SETTLE_SECONDS)
            parts = work()
            if number:
                for part, ms in parts.items():
                    found[name].setdefault(part, []).append(ms)
        on_round()
    return found
