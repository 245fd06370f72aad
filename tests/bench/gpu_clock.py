"""Times of work on a device: by its own events, candidates in turn, medians."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch

_ENOUGH = 10_000  # ms that one candidate may take in all; after that three rounds do
_LEAST_ROUNDS = 3
_HELD = 40_000_000  # cycles, about 20 ms: the host has started a whole step by then


def moment(device: str) -> Any:
    """Returns a point in the device's work, or in time where the device is the host."""
    if device == "cpu":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def between(first: Any, last: Any) -> float:
    """Returns the milliseconds between two moments, waiting for them."""
    if isinstance(first, float):
        return float(1000 * (last - first))
    last.synchronize()
    return float(first.elapsed_time(last))


def hold(device: str) -> None:
    """Keeps the device busy, so that what is started now runs without gaps later."""
    if device == "cuda":
        torch.cuda._sleep(_HELD)


def in_turn(
    works: Mapping[str, Callable[[], object]], rounds: int, device: str
) -> dict[str, list[float]]:
    """Returns milliseconds by candidate: A B A B, after one round that does not count."""
    found: dict[str, list[float]] = {name: [] for name in works}
    for work in works.values():
        work()
    for _ in range(rounds):
        for name, work in works.items():
            times = found[name]
            if len(times) >= _LEAST_ROUNDS and sum(times) > _ENOUGH:
                continue
            first = moment(device)
            work()
            times.append(between(first, moment(device)))
    return found


def middle(times: list[float]) -> float:
    """Returns the median."""
    return statistics.median(times)


def spread(times: list[float], per: float = 1) -> str:
    """Returns the range and number of the times, each divided by `per`."""
    return f"{min(times) / per:.2f} to {max(times) / per:.2f} in {len(times)} rounds"


def clear(device: str) -> None:
    """Gives back what nobody holds any more, so that the peak of memory is that of what follows."""
    gc.collect()
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


class StageClock:
    """Times functions while they are called; what one calls in turn counts for itself alone.

    Args:
        device: where the functions work.

    Attributes:
        results: what each returned last, by name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._spans: list[tuple[str, Any, Any, int]] = []  # name, from, to, place of the outer one
        self._outer: list[int] = []
        self.results: dict[str, Any] = {}

    def wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Returns the function with a clock around it."""

        def run(*args: Any, **options: Any) -> Any:
            place, outer = len(self._spans), self._outer[-1] if self._outer else -1
            first = moment(self._device)
            self._spans.append((name, first, None, outer))
            self._outer.append(place)
            result = self.results[name] = function(*args, **options)
            self._outer.pop()
            self._spans[place] = name, first, moment(self._device), outer
            return result

        return run

    def collect(self) -> dict[str, float]:
        """Returns the milliseconds by name since the last call, and begins anew."""
        whole = [between(first, last) for _, first, last, _ in self._spans]
        alone = list(whole)
        for (_, _, _, outer), ms in zip(self._spans, whole, strict=True):
            if outer >= 0:
                alone[outer] -= ms
        found: dict[str, float] = {}
        for (name, _, _, _), ms in zip(self._spans, alone, strict=True):
            found[name] = found.get(name, 0.0) + ms
        self._spans.clear()
        return found
