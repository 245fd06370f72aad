"""Seconds of this process, and the machine that they were measured on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from recon_cli import machine
from recon_cli.kernels.simd import LANES


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
