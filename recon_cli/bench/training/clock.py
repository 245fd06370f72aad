"""The clock of a training run: it stands still while pictures are scored."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class TrainingClock:
    """Sums up wall and CPU seconds of the blocks that it is told to time.

    Args:
        device: "cpu" or "cuda", whose queue is waited for.

    Attributes:
        seconds: on the wall.
        cpu_seconds: of all threads of this process.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self.seconds = self.cpu_seconds = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Counts the time of the block."""
        wall, cpu = self._now()
        try:
            yield
        finally:
            now_wall, now_cpu = self._now()
            self.seconds += now_wall - wall
            self.cpu_seconds += now_cpu - cpu

    def _now(self) -> tuple[float, float]:
        if self._device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter(), time.process_time()
