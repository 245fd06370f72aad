"""Measuring on this machine: clocks, timings in alternated rounds, memory."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import psutil
import torch

from recon_cli import machine
from recon_cli.evaluation.scores import number
from recon_cli.kernels.simd import LANES

# OpenMP's threads of the previous candidate keep spinning for some milliseconds after their work.
_SETTLE_SECONDS = 0.03
_SAMPLE_SECONDS = 0.001  # of resident memory; a forward pass takes some twenty

Samples = dict[str, list[float]]  # name of a part -> its milliseconds, round by round


@dataclass(frozen=True)
class Timing:
    """A measured time."""

    ms: float  # median over the rounds
    iqr_ms: float  # from the first to the third quartile; 0 for a single round

    @staticmethod
    def from_samples(samples: Sequence[float]) -> Timing:
        """Returns the median and the interquartile range of some milliseconds."""
        if not samples:
            raise ValueError("no samples")
        if len(samples) == 1:
            return Timing(samples[0], 0.0)
        first, middle, third = statistics.quantiles(samples, n=4, method="inclusive")
        return Timing(middle, third - first)

    def text(self, digits: int = 3) -> str:
        """Returns the median with the interquartile range in brackets."""
        return f"{number(self.ms, digits)} ({number(self.iqr_ms, 2)})"


class Clock:
    """Measures wall and CPU seconds since its creation, without its pauses; waits for a GPU."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._start = self._now()

    def seconds(self) -> tuple[float, float]:
        """Returns the wall seconds, and the CPU seconds of all threads of this process."""
        (wall, cpu), (wall_start, cpu_start) = self._now(), self._start
        return wall - wall_start, cpu - cpu_start

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Excludes the time of the block."""
        before = self.seconds()
        try:
            yield
        finally:
            wall, cpu = self._now()
            self._start = wall - before[0], cpu - before[1]

    def _now(self) -> tuple[float, float]:
        if self._device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter(), time.process_time()


class Stopwatch(Clock):
    """Measures the time between marks."""

    def __init__(self, device: str) -> None:
        super().__init__(device)
        self.ms: dict[str, float] = {}

    def mark(self, name: str) -> None:
        """Adds the time since the last mark to that of `name`."""
        now = self._now()
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now[0] - self._start[0])
        self._start = now


def alternate(
    works: Mapping[str, Callable[[], Mapping[str, float]]], rounds: int,
    on_round: Callable[[], None],
) -> dict[str, Samples]:
    """Runs all candidates in turn, A B A B, so that a slow minute affects all alike.

    Returns the samples of each. A first round that compiles and warms caches is not counted.
    """
    samples: dict[str, Samples] = {name: {} for name in works}
    for round_number in range(rounds + 1):
        for name, work in works.items():
            time.sleep(_SETTLE_SECONDS)
            parts = work()
            if round_number:
                for part, ms in parts.items():
                    samples[name].setdefault(part, []).append(ms)
        on_round()
    return samples


@dataclass(frozen=True)
class Host:
    """A machine and its programs."""

    cpu: str  # model name
    cores: int  # that this process may use
    threads: int  # in use
    lanes: int  # float32 in a vector of the kernels
    device: str  # "cpu", or the GPU's model name
    versions: dict[str, str]  # of Python and the packages

    @property
    def line(self) -> str:
        """One line for the head of a table."""
        place = "" if self.device == "cpu" else f", {self.device}"
        return (
            f"{self.cpu}{place}, {self.threads} of {self.cores} cores, {self.lanes} lanes, "
            f"torch {self.versions['torch']}, "
            f"numpy {self.versions['numpy']}, Python {self.versions['python']}")


def examine(threads: int, device: str) -> Host:
    """Returns this machine."""
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    return Host(
        machine.cpu_model(), machine.usable_threads(), threads, LANES, name,
        machine.versions())


def measure_memory(work: Callable[[], object], device: str) -> int:
    """Returns the peak bytes that `work` added: on a GPU those that torch allocated.

    On a CPU resident memory, sampled every millisecond, with the reserve of an allocator.
    """
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    process, done = psutil.Process(), threading.Event()
    start = peak = process.memory_info().rss

    def watch() -> None:
        nonlocal peak
        while not done.wait(_SAMPLE_SECONDS):
            peak = max(peak, process.memory_info().rss)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        work()
    finally:
        done.set()
        thread.join()
    added: int = max(peak, process.memory_info().rss) - start
    return added
