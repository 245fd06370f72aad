"""Timing work on a device: by its own events, candidates in turn, medians."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch

_ENOUGH = 10_000  # ms that one candidate may take in all; after that three rounds do
_LEAST_ROUNDS = 3


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
    """Frees unused memory, so that the peak of memory is that of the next part."""
    gc.collect()
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
