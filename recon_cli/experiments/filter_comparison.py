"""`recon denoise --compare`: gain and loss of each noise filter on the frames of a capture.

The reference is the capture's own frames reduced to half size by area, which halves their noise;
noise of known levels is added to it. Video compression is not simulated, so for a video the figures
are upper bounds. compare.json lies beside the stages, so that no stage becomes stale.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.noise import FILTERS, estimate_noise
from recon_cli.config.stages import DenoiseConfig
from recon_cli.evaluation.scores import Table
from recon_cli.experiments.outputs import Result
from recon_cli.experiments.runner import run_grid
from recon_cli.io.images import read_png
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.workspace.layout import disk_errors
from recon_cli.workspace.records import FOLDER, read_frame_list

_SAMPLES = 3  # frames, spread over the capture: 20 s in all at 1080x1920 on one core
_MEASURED = 16  # frames whose noise is measured: 3 s
_LEAST_NOISE = 0.5  # 1/255; rounding to 8 bits alone makes .3
LEVELS = (3.0, 5.0, 10.0, 15.0, 20.0)  # 1/255; 3 is the default threshold, 20 a phone at night
_SAME_LEVEL = 0.1  # relative: a measured level this close to one of those is not tested separately
STRENGTHS = (2.0, 3.0, 4.0, 5.0)
_STEEPEST = 95  # percentile: edges are the 5% of pixels with the steepest slope
_SLOPE_BLUR = 1.0  # pixels; without a blur before the slope, noise would count as edges
_MAX_EDGE_LOSS = 0.05  # fraction of the edges that the best filter may lose

Pixels = NDArray[np.uint8]  # [H, W, 3]


@dataclass(frozen=True)
class FilterVariant:
    """A filter at a strength, which is its range as a multiple of the noise."""

    filter: str  # "none" leaves the frame as it is
    strength: float  # 0 where there is none
    apply: Callable[[Pixels, float], Pixels]  # (frame, noise in 1/255)

    @property
    def key(self) -> str:
        """A name that no other variant has."""
        return f"{self.filter} {self.strength:g}"


@dataclass(frozen=True)
class FilterScore:
    """The result of one filter at one level of noise; means over the frames."""

    filter: str
    strength: float
    noise_255: float  # standard deviation of the added noise
    psnr_db: float  # against the frame without it
    edges_kept: float  # see `edges_kept`
    seconds_per_megapixel: float  # of the filter, on this machine


VARIANTS = (
    FilterVariant("none", 0.0, lambda rgb, _noise: rgb),
    *(FilterVariant(name, strength, partial(function, strength=strength))
      for name, function in FILTERS.items() for strength in STRENGTHS))


def compare_filters(job: Job, config: DenoiseConfig) -> Result:
    """Writes compare.json into the workspace and returns a table and a recommendation.

    Raises:
        StageError: there are no fresh frames.
        WorkspaceError: the workspace is in use or cannot be written.
        FormatError: a frame cannot be read.
    """
    root, frames = job.workspace.root, job.workspace.folder("ingest") / FOLDER
    plan.plan(job.inspect(), "denoise")
    with disk_errors(root, "comparing filters"), job.workspace.writing("denoise --compare"):
        names = [frame.name for frame in read_frame_list(frames.parent).frames]
        noise = float(np.median([estimate_noise(read_png(frames / name))
                                 for name in _pick_evenly(names, _MEASURED)]))
        samples = _pick_evenly(names, _SAMPLES)
        truths = [halve(read_png(frames / name)) for name in samples]
        levels = levels_with(noise)
        total = len(levels) * len(VARIANTS) * len(truths)
        with job.progress.bar("compare", total, unit="run") as bar:
            scores = score_filters(truths, levels, on_run=bar.advance)
        result = Result({
            "measured_noise_255": noise, "frames": samples,
            "reduced": "by area to half the size, before noise was added",
            "opencv_threads": cv2.getNumThreads(),
            "scores": [asdict(score) for score in scores],
        }, f"PSNR in dB and share of the edges kept, {len(samples)} frames at half their size with "
            "white noise added (in 1/255)", [_table(scores)], [_advice(config, noise, scores)])
        result.save(root, "compare")
    return result


def _pick_evenly(names: Sequence[str], count: int) -> list[str]:
    """Returns up to `count` names, evenly spread."""
    count = min(count, len(names))
    return [names[(2 * place + 1) * len(names) // (2 * count)] for place in range(count)]


def halve(frame: Pixels) -> Pixels:
    """Returns a frame at half its size by area, which halves noise that is independent."""
    height, width = frame.shape[:2]
    return np.asarray(
        cv2.resize(frame, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)


def levels_with(measured: float) -> tuple[float, ...]:
    """Returns the stated levels and the measured one, ascending, in 1/255."""
    own = round(measured, 1)
    near = any(abs(own - level) <= _SAME_LEVEL * level for level in LEVELS)
    return LEVELS if near or own < _LEAST_NOISE else tuple(sorted((own, *LEVELS)))


def score_filters(
    truths: Sequence[Pixels], levels: Sequence[float], *, on_run: Callable[[], None]
) -> tuple[FilterScore, ...]:
    """Returns a score for each filter and level of noise in 1/255, by filter, then by level."""
    megapixels = sum(truth.shape[0] * truth.shape[1] for truth in truths) / 1e6

    def measure(variant: FilterVariant, noisy: tuple[float, int]) -> tuple[float, float, float]:
        level, number = noisy
        frame = with_noise(truths[number], level, seed=number)
        start = time.perf_counter()
        result = variant.apply(frame, level)
        seconds = time.perf_counter() - start
        on_run()
        return cv2.PSNR(truths[number], result), edges_kept(truths[number], result), seconds

    grid = [(level, number) for level in levels for number in range(len(truths))]
    results = run_grid({variant.key: variant for variant in VARIANTS}, grid, measure)
    scores = []
    for variant in VARIANTS:
        values = np.array(results[variant.key]).reshape(len(levels), len(truths), 3)
        for level, of_level in zip(levels, values, strict=True):
            psnr_db, edges, seconds = of_level.T
            scores.append(FilterScore(
                variant.filter, variant.strength, level, float(np.mean(psnr_db)),
                float(np.mean(edges)),
                0.0 if variant.filter == "none" else float(sum(seconds)) / megapixels))
    return tuple(scores)


def with_noise(rgb: Pixels, noise: float, *, seed: int) -> Pixels:
    """Returns a frame with white Gaussian noise of a level in 1/255, clipped to 8 bits."""
    random = np.random.default_rng(seed)
    noisy = rgb + random.normal(0.0, noise, rgb.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def edges_kept(truth: Pixels, image: Pixels) -> float:
    """Returns the fraction of the slope across the edges of `truth` that is left in `image`.

    Along the true gradient of the steepest 5% of the pixels, so that noise cancels out.
    """
    across, down = _slopes(truth)
    steepness = np.hypot(across, down)
    edge = steepness >= max(np.percentile(steepness, _STEEPEST), np.finfo(np.float32).tiny)
    if not edge.any():
        return 1.0
    image_across, image_down = _slopes(image)
    along = (across * image_across + down * image_down)[edge] / steepness[edge]
    return float(along.sum() / steepness[edge].sum())


def _slopes(image: Pixels) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(gray, (0, 0), _SLOPE_BLUR)
    return cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)


def best(scores: Sequence[FilterScore], level: float) -> FilterScore:
    """Returns the best of the filters, or none, at the level nearest to `level`."""
    near = min((score.noise_255 for score in scores), key=lambda noise: abs(noise - level))
    usable = [
        score for score in scores
        if score.noise_255 == near
        and score.edges_kept >= _score_of_none(scores, near).edges_kept - _MAX_EDGE_LOSS]
    return max(usable, key=lambda score: score.psnr_db)


def gain_db(scores: Sequence[FilterScore], score: FilterScore) -> float:
    """Returns the gain in dB over doing nothing."""
    return score.psnr_db - _score_of_none(scores, score.noise_255).psnr_db


def _score_of_none(scores: Sequence[FilterScore], level: float) -> FilterScore:
    return next(score for score in scores if score.filter == "none" and score.noise_255 == level)


def _table(scores: Sequence[FilterScore]) -> Table:
    levels = sorted({score.noise_255 for score in scores})
    rows = []
    for first in range(0, len(scores), len(levels)):  # by filter, then by level
        own = scores[first:first + len(levels)]
        name, strength = own[0].filter, own[0].strength
        rows.append((
            name, f"{strength:g}" if strength else "-",
            *(f"{score.psnr_db:.1f} {score.edges_kept:4.0%}" for score in own),
            f"{sum(score.seconds_per_megapixel for score in own) / len(own):.2f}"))
    return Table(
        ("filter", "strength", *(f"noise {level:g}" for level in levels), "s/MP"), rows)


def _advice(config: DenoiseConfig, noise: float, scores: Sequence[FilterScore]) -> str:
    """Returns a recommendation for the frames' own noise."""
    lines = [f"The noise of the frames is {noise:.1f}/255 (median)."]
    chosen = best(scores, noise) if noise >= _LEAST_NOISE else None
    if chosen is None:
        lines.append("Rounding to 8 bits leaves as much: there is nothing to remove.")
    elif chosen.filter == "none":
        lines.append("Doing nothing is best at that level; recon denoise --off does that.")
    else:
        lines.append(
            f"Best at {chosen.noise_255:g}/255: --filter {chosen.filter} --strength "
            f"{chosen.strength:g}, {gain_db(scores, chosen):+.1f} dB if that noise is white, and "
            f"{chosen.edges_kept:.0%} of the edges kept.")
    leaves_frames = noise < config.threshold and config.mode == "auto"
    lines.append(
        f"recon denoise leaves frames below --threshold {config.threshold:g} as they are."
        if leaves_frames else
        f"recon denoise would use --filter {config.filter} --strength {config.strength:g}.")
    return "\n".join(lines)
