"""Reports that come often, passed on seldom."""

from __future__ import annotations

import time
from collections.abc import Callable

EVERY_SECONDS = 0.5  # a person sees no difference, and a disk write costs nothing at this pace


def paced(record: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Returns `record(done, total)` that lets calls through every half second and at the end."""
    last = float("-inf")

    def report(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if done == total or now - last >= EVERY_SECONDS:
            last = now
            record(done, total)

    return report
