"""Quality over time as a curve through the points of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from recon_cli.bench.training.trial import Point

LOOKS = 20  # along a run: each scores all validation views


def looks(iterations: int, count: int = LOOKS) -> tuple[int, ...]:
    """Returns the steps to look after: 0, and `count` evenly spread ones up to the last."""
    return tuple(sorted({round(i * iterations / count) for i in range(count + 1)}))


def seconds_to(
    points: Sequence[Point], target_db: float, seconds: Callable[[Point], float]
) -> float | None:
    """Returns when a curve first reaches a PSNR, on straight lines between its points.

    Args:
        points: of one run, in order.
        target_db: to reach.
        seconds: of a point: on the wall or of the CPU.

    Returns:
        Seconds; None where no point reaches the target.
    """
    before: Point | None = None
    for point in points:
        if point.psnr_db >= target_db:
            if before is None:
                return seconds(point)
            share = (target_db - before.psnr_db) / (point.psnr_db - before.psnr_db)
            return seconds(before) + share * (seconds(point) - seconds(before))
        before = point
    return None


def common_target(runs: Sequence[Sequence[Point]]) -> float:
    """Returns the PSNR that every run reaches, down to a tenth of a dB."""
    best = min(max(point.psnr_db for point in points) for points in runs)
    return math.floor(10 * best) / 10
