"""How long work takes, told before it is done: a table of costs, for a machine of some speed.

A cost is CPU seconds for a piece of work of some size. `COSTS` are those of one machine, fitted to
finished workspaces (`tests/bench/bench_sfm_estimate.py`); how slow this machine is right now is
measured by a piece of the same kind of work, for a fraction of a second on all threads. A training
is timed on this machine itself (`train/cost.py`), as its steps differ with scene and options.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

# Seconds of the piece of work on the machine of `COSTS`, on a core that has nothing else to do.
PIECE_SECONDS = 0.0146
MEASURES = 15
BLURS = (1.6, 2.0, 2.5, 3.2, 4.0, 5.0)
# Of float32 products, as in matching. No BLAS shares one of 64 x 64 among threads of its own.
PRODUCTS = (512, 64, 64)
LEAST_NOTICE = 60.0  # seconds that are worth a notice
OVERLAP_SHARE = 1 / 6  # of a segment's frames, which are mapped in the next one as well


@dataclass(frozen=True)
class Cost:
    """CPU seconds of a piece of work: fixed + each x its size."""

    fixed: float = 0.0
    each: float = 0.0  # for every megapixel of an image, or thousand Gaussians

    def seconds(self, size: float = 0.0) -> float:
        """Returns the CPU seconds of a piece of this size."""
        return self.fixed + self.each * size

    def times(self, fixed: float, each: float) -> Cost:
        """Returns the cost of which both parts are so many times as high."""
        return Cost(self.fixed * fixed, self.each * each)


# On a CPU with AVX2. Of walks: fitted to nine (tests/bench/notes/cameras.md). Of photos: those of
# a CPU with AVX-512, which takes 1.6 times less; no set of photos has been timed on this one.
COSTS = {
    "picture": Cost(each=0.1),  # of a video, to read it
    "walk": Cost(0.087, 1.192),  # to find and undistort the features of a frame, and to place it
    "keyframe": Cost(0.383),  # to match one
    "walk_mapping": Cost(0.158),  # to map a keyframe
    "photo": Cost(0.45, 0.61),  # to find, match and undistort the features
    "photo_mapping": Cost(0.27),
    "split": Cost(1.6),  # to match a photo with all that look alike, where they are cut in segments
    "join": Cost(0.32),  # to join segments, for each frame
    "pair": Cost(0.05),  # of images of 3,000 keypoints, verification included
    "scores": Cost(15.0),  # evaluate, export and report: rooms took 10 to 13
}


@dataclass(frozen=True)
class Work:
    """Pieces of work that have the same cost."""

    kind: str  # of a table of costs
    count: float
    size: float = 0.0  # see `Cost.each`
    shared: bool = False  # by all threads; else one of them does it


@dataclass(frozen=True)
class TimeEstimator:
    """Tells how long work takes on a machine."""

    costs: Mapping[str, Cost]
    threads: int = 1
    slowness: float = 1.0  # how many times as long as the costs say the machine takes
    seconds: float = 0.0  # that it took to find the costs

    def total(self, work: Iterable[Work]) -> float:
        """Returns the seconds of all the work together."""
        return self.slowness * sum(
            each.count * self.costs[each.kind].seconds(each.size)
            / (self.threads if each.shared else 1) for each in work)


def measure_machine(threads: int) -> TimeEstimator:
    """Returns the estimator of `COSTS` for this machine, as fast as it is now."""
    return TimeEstimator(COSTS, threads, measure_slowness(threads))


def measure_slowness(threads: int) -> float:
    """Returns how many times as long this machine takes now as that of COSTS, on all threads."""
    generator = np.random.default_rng(0)
    image = generator.random((480, 640), np.float32)
    rows = generator.random(PRODUCTS, np.float32)

    def take(_: int) -> float:
        start = time.monotonic()
        for sigma in BLURS:  # as for the octaves of features
            cv2.GaussianBlur(image, (0, 0), sigma)
        np.sort(image.ravel())
        np.matmul(rows, rows)
        return time.monotonic() - start

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            seconds = list(pool.map(take, range(MEASURES * threads)))
    finally:
        cv2.setNumThreads(before)
    return float(np.mean(seconds)) / PIECE_SECONDS


def list_mapping(
    frames: int, megapixels: float, *, tracked: bool, segments: int = 1,
    keyframes: int | None = None,
) -> list[Work]:
    """Returns the work of finding the cameras of a capture, as far as it is known before.

    That a model falls short, so that another mapper is tried, cannot be known; it is said when it
    happens.

    Args:
        frames: Of the capture.
        megapixels: Of a frame.
        tracked: The frames are those of a walk, linked by tracks.
        segments: That are mapped apart.
        keyframes: Of a walk, that matches are sought between; None: all frames.
    """
    kind, apart = "walk" if tracked else "photo", segments > 1
    paid = frames * (1 + OVERLAP_SHARE) if apart else float(frames)
    mapped = paid * (keyframes or frames) / frames
    return [
        Work(kind, paid, megapixels, shared=True),
        Work(f"{kind}_mapping", mapped, shared=apart),
        *[Work("keyframe", mapped, shared=True)] * tracked,
        *[Work("join", frames)] * apart,
        *[Work("split", frames, shared=True)] * (apart and not tracked)]


def estimate_for_notice(work: Iterable[Work], threads: int) -> float | None:
    """Returns the seconds that a notice says in advance; None where they are too few for one."""
    seconds = TimeEstimator(COSTS, threads).total(work)
    if seconds > LEAST_NOTICE / 2:  # else the measure is not worth its time
        seconds *= measure_slowness(threads)
    return seconds if seconds >= LEAST_NOTICE else None


def format_minutes(seconds: float) -> str:
    """Returns a time that is known to a third, in minutes."""
    minutes = seconds / 60
    text = f"{minutes:,.0f}" if minutes >= 9.95 else f"{minutes:.1f}".removesuffix(".0")
    return f"{text} minute{'s' if text != '1' else ''}"
