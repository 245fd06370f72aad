"""The memory that a piece of work adds, as the operating system sees it."""

from __future__ import annotations

import threading
from collections.abc import Callable

import psutil
import torch

_SAMPLE_SECONDS = 0.001  # a forward pass takes some twenty


def added_memory(work: Callable[[], object], device: str) -> int:
    """Returns the most bytes above those at the start that `work` held.

    On a CPU this is resident memory, sampled every millisecond, which misses short peaks and
    counts what an allocator keeps; on a GPU it is what torch allocated.
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
