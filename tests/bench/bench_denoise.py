"""Measures what noise filters gain and what edges they cost.

`python tests/bench/bench_denoise.py FOLDER...` adds noise of known levels to two images of each
folder, those of more than 1000 pixels halved by area first, and prints means over the folders:
recon's bilateral filter against two joint bilateral filters, which recon had until they gained less
than .2 dB on phone video at 4.5 times the time (they need opencv-contrib-python-headless).

`python tests/bench/bench_denoise.py --decoded VIDEO FOLDER` compares decoded frames of a noisy
video with its clean frames (FOLDER, frame k = k-th by name), before and after a filter; each
channel's gain and offset are fitted first, for the exposure drifts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click
import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.noise import bilateral, estimate_noise
from recon_cli.capture.video import frames_at
from recon_cli.experiments.runner import run_grid

LEVELS = (5.0, 10.0, 15.0, 20.0)
LARGE = 1000  # pixels
PLACES = (0.25, 0.7)  # of the images of a folder
NOISES = (1.0, 3.0, 5.0)  # 1/255, what a filter is told of decoded frames
DECODED = 6  # frames
STRENGTH = 4.0
STRENGTHS = (2.0, 3.0, 4.0, 5.0)
STEEPEST = 95  # percentile: edges are the 5% of pixels with the steepest slope
SLOPE_BLUR = 1.0  # pixels; without a blur before the slope, noise would count as edges
# Blur of the first guide. .5 keeps more noise (-.2 dB at 20), .7 blurs fine texture (-.3 dB at 5).
GUIDE_BLUR, GUIDE_BLUR_SIZE = 0.6, 5
# Window of the second guide; that of the result is 9, .5 dB more than 7 at noise of 20.
GUIDE_DIAMETER, GUIDE_SIGMA_SPACE = 5, 1.0
JOINT_DIAMETER, JOINT_SIGMA_SPACE = 9, 2.5

Pixels = NDArray[np.uint8]  # [H, W, 3]


def joint(
    rgb: Pixels,  # [H, W, 3]
    noise: float,  # its standard deviation in 1/255
    strength: float,  # range sigma as a multiple of the noise that is left in the blurred guide
) -> Pixels:  # [H, W, 3]
    """Returns a frame after two joint bilateral filters, each with a less noisy guide.

    The weights come from a guide instead of the frame (Petschnigg et al. 2004, Eisemann and Durand
    2004): first the frame slightly blurred, then the result of that (Zhang et al. 2014, rolling
    guidance). Less noise in the weights lets the range be half as wide, which keeps edges.
    """
    # Share of white noise that the separable blur leaves: the sum of squares along one axis.
    left = float(np.sum(cv2.getGaussianKernel(GUIDE_BLUR_SIZE, GUIDE_BLUR) ** 2))
    reach = strength * left * noise
    blurred = cv2.GaussianBlur(rgb, (GUIDE_BLUR_SIZE, GUIDE_BLUR_SIZE), GUIDE_BLUR)
    guide = cv2.ximgproc.jointBilateralFilter(
        blurred, rgb, GUIDE_DIAMETER, reach, GUIDE_SIGMA_SPACE)
    return np.asarray(cv2.ximgproc.jointBilateralFilter(
        guide, rgb, JOINT_DIAMETER, reach, JOINT_SIGMA_SPACE), np.uint8)


FILTERS = {"joint": joint, "bilateral": bilateral}


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


def halve(frame: Pixels) -> Pixels:
    """Returns a frame at half its size by area, which halves noise that is independent."""
    height, width = frame.shape[:2]
    return np.asarray(
        cv2.resize(frame, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)


def score_filters(
    truths: Sequence[Pixels], levels: Sequence[float]
) -> tuple[FilterScore, ...]:
    """Returns a score for each filter and level of noise in 1/255, by filter, then by level."""
    megapixels = sum(truth.shape[0] * truth.shape[1] for truth in truths) / 1e6

    def measure(variant: FilterVariant, noisy: tuple[float, int]) -> tuple[float, float, float]:
        level, number = noisy
        frame = with_noise(truths[number], level, seed=number)
        start = time.perf_counter()
        result = variant.apply(frame, level)
        seconds = time.perf_counter() - start
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
    across, down = slopes(truth)
    steepness = np.hypot(across, down)
    edge = steepness >= max(np.percentile(steepness, STEEPEST), np.finfo(np.float32).tiny)
    if not edge.any():
        return 1.0
    image_across, image_down = slopes(image)
    along = (across * image_across + down * image_down)[edge] / steepness[edge]
    return float(along.sum() / steepness[edge].sum())


def slopes(image: Pixels) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(gray, (0, 0), SLOPE_BLUR)
    return cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)


def load(path: Path) -> Pixels:
    """Returns an image, [H, W, 3], halved where it is large."""
    rgb = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    return halve(rgb) if max(rgb.shape) > LARGE else rgb


def images(folder: Path) -> list[Path]:
    """Returns the JPEGs and PNGs of a folder that are no depth maps."""
    return sorted(
        path for path in folder.iterdir()
        if path.suffix in {".jpg", ".png"} and not path.name.startswith("depth"))


def fitted(image: Pixels, truth: Pixels) -> Pixels:
    """Returns an image with the gain and offset of each channel that bring it closest."""
    result = np.empty(image.shape)
    for channel in range(3):
        gain, offset = np.polyfit(image[..., channel].ravel(), truth[..., channel].ravel(), 1)
        result[..., channel] = gain * image[..., channel] + offset
    return np.clip(np.round(result), 0, 255).astype(np.uint8)


def print_added(folders: Sequence[Path]) -> None:
    """Prints a line for each filter and strength: PSNR and edges kept, level by level."""
    truths = []
    for folder in folders:
        found = images(folder)
        truths += [load(found[int(place * len(found))]) for place in PLACES]
    scores = score_filters(truths, LEVELS)
    for name, strength in dict.fromkeys((score.filter, score.strength) for score in scores):
        own = [one for one in scores if (one.filter, one.strength) == (name, strength)]
        figures = "  ".join(f"{one.psnr_db:.2f} {one.edges_kept:.3f}" for one in own)
        seconds = np.mean([one.seconds_per_megapixel for one in own])
        click.echo(f"{name:<16} {strength:<4g} {figures}  {seconds:.3f} s/MP")


def print_decoded(video: Path, folder: Path) -> None:
    """Prints a line for each frame: its noise, and PSNR before and after each filter."""
    found = images(folder)
    places = [(2 * k + 1) * len(found) // (2 * DECODED) for k in range(DECODED)]
    for index, rgb in frames_at(video, places, threads=1):
        truth = cv2.cvtColor(cv2.imread(str(found[index])), cv2.COLOR_BGR2RGB)
        words = [f"{index:>3} noise {estimate_noise(rgb):.2f}",
                 f"none {cv2.PSNR(fitted(rgb, truth), truth):.2f}"]
        for name, function in FILTERS.items():
            after = [cv2.PSNR(fitted(function(rgb, noise, STRENGTH), truth), truth)
                     for noise in NOISES]
            words.append(f"{name} " + " ".join(f"{value:.2f}" for value in after))
        click.echo("  ".join(words))


@click.command()
@click.argument(
    "folders", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--decoded", type=click.Path(exists=True, path_type=Path), help="A noisy video.")
def main(folders: tuple[Path, ...], decoded: Path | None) -> None:
    """Compares filters on the images of FOLDERS, on one thread."""
    cv2.setNumThreads(1)
    if decoded is None:
        print_added(folders)
    else:
        print_decoded(decoded, folders[0])


if __name__ == "__main__":
    main()
