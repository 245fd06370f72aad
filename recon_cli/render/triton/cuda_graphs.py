"""CUDA graphs: work that is started repeatedly in the same sizes is recorded and replayed.

A recording holds sizes and addresses: what differs from step to step must lie in memory.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from typing import Protocol

import torch

_BEFORE = 2  # times that work is run unrecorded: kernels are compiled, and few steps need no more
_MOST = 8  # recordings that are kept at a time

logger = logging.getLogger("recon")

Work = Callable[[], None]


class Recorder(Protocol):
    """Turns work into work that does the same to the same memory."""

    def reset(self) -> None:
        """Frees the memory of all recordings, once nothing refers to them."""

    def __call__(self, work: Work) -> Work:
        """Returns a function that replays the work; RuntimeError if it cannot be recorded."""


class Graphs:
    """Records work that comes up again; without a recorder all work runs unrecorded."""

    def __init__(self, recorder: Recorder | None) -> None:
        self._recorder = recorder
        self._times: dict[Hashable, int] = {}
        self._recorded: dict[Hashable, Work] = {}

    @staticmethod
    def for_device(device: torch.device) -> Graphs:
        """Returns CUDA graphs on a CUDA device, and no recording elsewhere."""
        return Graphs(_CudaGraphs(device) if device.type == "cuda" else None)

    def run(self, key: Hashable, work: Work) -> None:
        """Runs the work, by its recording once there is one.

        `key` holds all sizes and addresses: equal keys mean the same launches.
        """
        if self._recorder is None:
            work()
            return
        self._times[key] = self._times.get(key, 0) + 1
        if self._times[key] <= _BEFORE:
            work()
            return
        if key not in self._recorded:
            if len(self._recorded) >= _MOST:
                self._recorded.pop(next(iter(self._recorded)))
            try:
                self._recorded[key] = self._recorder(work)
            except RuntimeError as error:  # the driver's, of whatever kind; nothing was done yet
                logger.warning("training continues without CUDA graphs, more slowly: %s", error)
                self._recorder = None
                work()
                return
        self._recorded[key]()

    def forget(self) -> None:
        """Drops all recordings, for sizes or addresses have changed."""
        self._times.clear()
        if self._recorded and self._recorder is not None:
            self._recorded.clear()
            self._recorder.reset()


class _CudaGraphs:
    """Records CUDA graphs, which share their memory: only one of them runs at a time."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()

    def reset(self) -> None:
        """Takes another pool: torch refuses one whose graphs are all gone."""
        self._pool = torch.cuda.graph_pool_handle()
        torch.cuda.empty_cache()  # or the old one's blocks would stay until memory runs out

    def __call__(self, work: Work) -> Work:
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        # not by torch.cuda.graph: it waits for the device and empties the allocator's cache
        with torch.cuda.stream(self._stream):
            # thread_local: a viewer may use the device meanwhile
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
        torch.cuda.current_stream(self._device).wait_stream(self._stream)

        def replay(_reads_from: Work = work) -> None:  # its memory must stay
            graph.replay()

        return replay
