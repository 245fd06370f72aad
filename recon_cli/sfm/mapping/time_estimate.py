"""How long finding the cameras takes, said before it starts.

It follows from the frames, their size and the way they go, and from how fast this machine is right
now: a piece of work of the same kind, for a fraction of a second on all threads. That a model falls
short, so that another mapper is tried, cannot be known before; it is said when it happens.
`tests/bench/bench_sfm_estimate.py` compares with what finished workspaces took, and fits `COSTS`.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import cv2
import numpy as np

# Seconds of the piece of work on the machine of `COSTS`, on a core that has nothing else to do.
PIECE_SECONDS = 0.0146
MEASURES = 15
BLURS = (1.6, 2.0, 2.5, 3.2, 4.0, 5.0)
# Of float32 products, as in matching. No BLAS shares one of 64 x 64 among threads of its own.
PRODUCTS = (512, 64, 64)
LEAST_NOTICE = 60.0  # seconds that are worth a notice


@dataclass(frozen=True)
class Workload:
    """What is known of a capture before it is mapped."""

    frames: int
    megapixels: float  # of a frame
    tracked: bool  # the frames are those of a walk, linked by tracks
    segments: int = 1  # that are mapped apart
    keyframes: int | None = None  # of a walk, that matches are sought between; None: all frames


@dataclass(frozen=True)
class Costs:
    """Seconds of one core for a frame, or where that is said for a keyframe."""

    walk: float  # to find and undistort the features of a walk's frame, and to place it
    walk_megapixel: float  # the same, for each megapixel of it
    keyframe: float  # to match a keyframe
    walk_mapping: float  # to map a keyframe; of one core, whatever their number
    photo: float  # to find, match and undistort the features of a photo
    photo_megapixel: float
    photo_mapping: float
    split: float  # to match it with all that look alike, where photos are cut into segments
    join: float  # to join segments; of one core


# On a CPU with AVX2. Of walks: fitted to nine (tests/bench/notes/cameras.md). The others: those
# of a CPU with AVX-512, which takes 1.6 times less; no set of photos has been timed on this one.
COSTS = Costs(
    walk=0.087, walk_megapixel=1.192, keyframe=0.383, walk_mapping=0.158,
    photo=0.45, photo_megapixel=0.61, photo_mapping=0.27, split=1.6, join=0.32)
OVERLAP_SHARE = 1 / 6  # of a segment's frames, which are mapped in the next one as well


def list_work(work: Workload) -> dict[str, tuple[float, bool]]:
    """Returns how often each of `Costs` is paid, and whether all cores share it."""
    kind = "walk" if work.tracked else "photo"
    apart = work.segments > 1
    frames = work.frames * (1 + OVERLAP_SHARE) if apart else float(work.frames)
    mapped = frames * (work.keyframes or work.frames) / work.frames
    items = {kind: (frames, True), f"{kind}_megapixel": (frames * work.megapixels, True),
             f"{kind}_mapping": (mapped, apart)}
    if work.tracked:
        items["keyframe"] = (mapped, True)
    if apart:
        items["join"] = (float(work.frames), False)
        if not work.tracked:
            items["split"] = (float(work.frames), True)
    return items


def expected_seconds(
    work: Workload, threads: int, *, costs: Costs = COSTS, slowness: float = 1.0
) -> float:
    """Returns about how long it takes; `slowness` multiplies the seconds of the machine of COSTS.
    """
    prices: dict[str, float] = asdict(costs)
    return slowness * sum(
        count * prices[name] / (threads if shared else 1)
        for name, (count, shared) in list_work(work).items())


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


def format_minutes(seconds: float) -> str:
    """Returns a time that is known to a third, in minutes."""
    minutes = seconds / 60
    text = f"{minutes:,.0f}" if minutes >= 9.95 else f"{minutes:.1f}".removesuffix(".0")
    return f"{text} minute{'s' if text != '1' else ''}"


def estimate_for_notice(work: Workload, threads: int) -> float | None:
    """Returns the seconds that a notice says in advance; None where they are too few for one."""
    seconds = expected_seconds(work, threads)
    if seconds > LEAST_NOTICE / 2:  # else the measure is not worth its time
        seconds *= measure_slowness(threads)
    return seconds if seconds >= LEAST_NOTICE else None
