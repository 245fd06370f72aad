"""Measures what noise filters gain and what edges they cost.

`python tests/bench/bench_denoise.py FOLDER...` adds noise of known levels to two images of each
folder, those of more than 1000 pixels halve by area first, and prints means over the folders.

`python tests/bench/bench_denoise.py --decoded VIDEO FOLDER` compares decoded frames of a noisy
video with its clean frames (FOLDER, frame k = k-th by name), before and after a filter; each
channel's gain and offset are fitted first, for the exposure drifts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.noise import FILTERS, estimate_noise
from recon_cli.capture.video import frames_at
from recon_cli.experiments import filter_comparison

LEVELS = (5.0, 10.0, 15.0, 20.0)
LARGE = 1000  # pixels
PLACES = (0.25, 0.7)  # of the images of a folder
NOISES = (1.0, 3.0, 5.0)  # 1/255, what a filter is told of decoded frames
DECODED = 6  # frames
STRENGTH = 4.0


def load(path: Path) -> NDArray[np.uint8]:
    """Returns an image, [H, W, 3], halve where it is large."""
    rgb = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    return filter_comparison.halve(rgb) if max(rgb.shape) > LARGE else rgb


def images(folder: Path) -> list[Path]:
    """Returns the JPEGs and PNGs of a folder that are no depth maps."""
    return sorted(
        path for path in folder.iterdir()
        if path.suffix in {".jpg", ".png"} and not path.name.startswith("depth"))


def fitted(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.uint8]:
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
    scores = filter_comparison.score_filters(truths, LEVELS, on_run=lambda: None)
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
