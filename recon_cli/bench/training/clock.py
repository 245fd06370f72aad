"""The clock of a training run: it stands still while pictures are scored."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class TrainingClock:
    """Counts wall and CPU seconds from its making on, but for its pauses.

    Args:
        device: "cpu" or "cuda", whose queue is waited for.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._zero = self._now()

    def seconds(self) -> tuple[float, float]:
        """Returns the seconds on the wall, and those of all threads of this process."""
        wall, cpu = self._now()
        return wall - self._zero[0], cpu - self._zero[1]

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leaves out the time of the block."""
        began = self._now()
        try:
            yield
        finally:
            ended = self._now()
            self._zero = (self._zero[0] + ended[0] - began[0], self._zero[1] + ended[1] - began[1])

    def _now(self) -> tuple[float, float]:
        if self._device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter(), time.process_time()
