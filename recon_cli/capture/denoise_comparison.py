"""What each noise filter would gain and lose on the frames of one capture.

The truth is not known, so it is made: the capture's own frames, halved by area, which leaves half
of their noise, and noise of known levels added to those. Compression, which follows noise in a
video, is not imitated; on a video the figures are therefore what a filter could do at best.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.filters import FILTERS

LEVELS = (3.0, 5.0, 10.0, 15.0, 20.0)  # 1/255; 3 is the default threshold, 20 a phone at night
# A measured level this close to one of those, or under .5, tells nothing of its own.
SAME_LEVEL, LEAST_LEVEL = 0.1, 0.5
STRENGTHS = (2.0, 3.0, 4.0, 5.0)
# Edges: the 5% of pixels with the steepest slope, where a blur is seen first.
STEEPEST = 95
# The slope is taken after a blur of one pixel; without it noise would make edges of its own.
SLOPE_BLUR = 1.0
# A filter that loses more than this share of the edges is no default, however flat the walls.
MOST_EDGE_LOSS = 0.05

Frame = NDArray[np.uint8]  # [H, W, 3]
Candidate = Callable[[Frame, float], Frame]  # (frame, noise in 1/255)


@dataclass(frozen=True)
class Score:
    """What one filter does at one level of noise; means over the frames.

    Attributes:
        filter: its name; "none" leaves the frame as it is.
        strength: its range as a multiple of the noise; 0 where there is none.
        offered: whether `recon denoise --filter` takes it.
        noise_255: standard deviation of the noise that was added.
        psnr_db: against the frame without it.
        edges_kept: `edges_kept` against the frame without it.
        seconds_per_megapixel: of the filter, on this machine.
    """

    filter: str
    strength: float
    offered: bool
    noise_255: float
    psnr_db: float
    edges_kept: float
    seconds_per_megapixel: float


def edges_kept(truth: Frame, image: Frame) -> float:
    """Returns how much of the slope across the edges of `truth` is left in `image`.

    The mean slope of the image along the true gradient over the steepest 5% of the pixels, divided
    by that of the truth: 1 where all edges stand, less where they are washed out. Noise, whose
    slope points anywhere, cancels out.

    Args:
        truth: without noise, [H, W, 3].
        image: filtered, of the same size.
    """
    across, down = _slopes(truth)
    steepness = np.hypot(across, down)
    edge = steepness >= max(np.percentile(steepness, STEEPEST), np.finfo(np.float32).tiny)
    if not edge.any():
        return 1.0
    found_across, found_down = _slopes(image)
    along = (across * found_across + down * found_down)[edge] / steepness[edge]
    return float(along.sum() / steepness[edge].sum())


def _slopes(image: Frame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(gray, (0, 0), SLOPE_BLUR)
    return cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)


def halved(frame: Frame) -> Frame:
    """Returns a frame at half its size by area, which halves noise that is independent."""
    height, width = frame.shape[:2]
    return np.asarray(
        cv2.resize(frame, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)


def levels_with(measured: float) -> tuple[float, ...]:
    """Returns the stated levels and the measured one, ascending, in 1/255."""
    own = round(measured, 1)
    near = any(abs(own - level) <= SAME_LEVEL * level for level in LEVELS)
    return LEVELS if near or own < LEAST_LEVEL else tuple(sorted((own, *LEVELS)))


def compare(
    truths: Sequence[Frame],
    levels: Sequence[float],
    *,
    step: Callable[[], None],
) -> tuple[Score, ...]:
    """Returns a score for each filter and level of noise, by filter, then by level.

    Args:
        truths: frames that pass for noiseless, each [H, W, 3].
        levels: standard deviations of the noise to add, in 1/255.
        step: called after each of `steps(levels)`.
    """
    return tuple(
        _score(name, strength, candidate, truths, level, step)
        for name, strength, candidate in _candidates()
        for level in levels)


def steps(levels: Sequence[float]) -> int:
    """Returns how often `compare` calls `step`."""
    return len(levels) * sum(1 for _ in _candidates())


def best(scores: Sequence[Score], level: float) -> Score:
    """Returns the best score among the offered filters, at the compared level nearest to `level`.

    Best is the highest PSNR among those that lose few edges; doing nothing is offered too.
    """
    near = min((score.noise_255 for score in scores), key=lambda one: abs(one - level))
    usable = [
        score for score in scores
        if score.noise_255 == near and score.offered
        and score.edges_kept >= _untouched(scores, near).edges_kept - MOST_EDGE_LOSS]
    return max(usable, key=lambda score: score.psnr_db)


def gain(scores: Sequence[Score], score: Score) -> float:
    """Returns by how many dB a filter comes closer to the truth than doing nothing."""
    return score.psnr_db - _untouched(scores, score.noise_255).psnr_db


def _untouched(scores: Sequence[Score], level: float) -> Score:
    return next(
        score for score in scores if score.filter == "none" and score.noise_255 == level)


def _candidates() -> Iterator[tuple[str, float, Candidate]]:
    """Yields name, strength and function of all that is compared."""
    yield "none", 0.0, lambda rgb, _noise: rgb
    for name, function in FILTERS.items():
        for strength in STRENGTHS:
            yield name, strength, partial(function, strength=strength)
    for name, (strength, reference) in _REFERENCES.items():
        yield name, strength, reference


def _guided(rgb: Frame, noise: float) -> Frame:
    return np.asarray(cv2.ximgproc.guidedFilter(rgb, rgb, 2, (1.5 * noise) ** 2), np.uint8)


def _non_local_means(rgb: Frame, noise: float) -> Frame:
    return np.asarray(
        cv2.fastNlMeansDenoisingColored(rgb, None, 0.8 * noise, 0.8 * noise, 5, 15), np.uint8)


# Filters that are not offered, each at the strength that was best on fox and the rendered rooms.
_REFERENCES: Mapping[str, tuple[float, Candidate]] = {
    "guided": (1.5, _guided), "non-local means": (0.8, _non_local_means)}


def _score(
    name: str, strength: float, candidate: Candidate, truths: Sequence[Frame], level: float,
    step: Callable[[], None],
) -> Score:
    psnrs, edges, seconds = [], [], 0.0
    for number, truth in enumerate(truths):
        spoiled = with_noise(truth, level, seed=number)
        start = time.perf_counter()
        result = candidate(spoiled, level)
        seconds += time.perf_counter() - start
        psnrs.append(cv2.PSNR(truth, result))
        edges.append(edges_kept(truth, result))
    step()
    megapixels = sum(truth.shape[0] * truth.shape[1] for truth in truths) / 1e6
    score = Score(
        name, strength, name == "none" or name in FILTERS, level, float(np.mean(psnrs)),
        float(np.mean(edges)), seconds / megapixels)
    return replace(score, seconds_per_megapixel=0.0) if name == "none" else score


def with_noise(
    rgb: Frame,  # [H, W, 3]
    noise: float,
    *,
    seed: int,
) -> Frame:
    """Returns a frame with white Gaussian noise of a level in 1/255, clipped to what fits."""
    random = np.random.default_rng(seed)
    spoiled = rgb + random.normal(0.0, noise, rgb.shape)
    return np.clip(np.round(spoiled), 0, 255).astype(np.uint8)
