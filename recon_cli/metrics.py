"""PSNR and SSIM of rendered views, and the tables that show them."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

PSNR_CONVENTION = "mean of per-image dB, float render clamped to [0, 1] against 8-bit truth"
SSIM_CONVENTION = (
    "scikit-image: 11x11 Gaussian window, sigma 1.5, 5 px border cropped, mean of channels")
MASK_CONVENTION = (
    "ignored pixels have no part in the squared error; the map of SSIM is averaged over the others")
MIN_SIDE = 11  # pixels; the window of SSIM
MIN_PIXELS = MIN_SIDE**2  # that a mask must leave: one window of SSIM
_BORDER = MIN_SIDE // 2  # pixels; what scikit-image crops, where the window reaches outside


@dataclass(frozen=True)
class ViewScore:
    """The scores of one held-out view.

    Attributes:
        name: of the view.
        psnr_db: peak signal-to-noise ratio in dB.
        ssim: structural similarity.
        pixels_scored: share of the pixels that a mask leaves; None without a mask.
    """

    name: str
    psnr_db: float
    ssim: float
    pixels_scored: float | None = None


@dataclass(frozen=True)
class ModelScore:
    """The scores of one model over all held-out views.

    Attributes:
        label: how tables call it.
        views: per view, by name.
        gaussians: count.
        bytes: size of its .ply.
        render_ms: median milliseconds a view.
        train_seconds: seconds of training that led to it.
    """

    label: str
    views: tuple[ViewScore, ...]
    gaussians: int
    bytes: int
    render_ms: float
    train_seconds: float

    @property
    def psnr_db(self) -> float:
        """Mean over the views of the PSNR in dB."""
        return float(np.mean([view.psnr_db for view in self.views]))

    @property
    def ssim(self) -> float:
        """Mean over the views of the SSIM."""
        return float(np.mean([view.ssim for view in self.views]))


def leaves_enough(mask: NDArray[np.bool_]) -> bool:
    """Tells whether at least MIN_PIXELS pixels of a mask [H, W] count off the border."""
    return int(np.count_nonzero(_cropped(mask))) >= MIN_PIXELS


def psnr(
    image: NDArray[np.float32], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns 10 log10(1 / MSE) in dB of an image [H, W, 3], clamped to [0, 1].

    Equal images would be infinite, which JSON cannot hold: they give 100 dB, less than one part
    in 10^5 of an 8-bit step.

    Args:
        image: [H, W, 3].
        truth: [H, W, 3].
        mask: [H, W], True where a pixel counts; None where all do.
    """
    error = np.clip(image, 0, 1).astype(np.float64) - truth / 255.0
    if mask is not None:
        error = error[mask]
    return float(-10 * np.log10(max(float(np.mean(error**2)), 1e-10)))


def ssim(
    image: NDArray[np.float32], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns the structural similarity of an image [H, W, 3] clamped to [0, 1].

    With a mask: the mean of the map over the pixels that count, of an image that is the truth
    elsewhere. The truth under the mask lies in their windows; `io.images.painted` makes it neutral.

    Args:
        image: [H, W, 3].
        truth: [H, W, 3].
        mask: [H, W], True where a pixel counts; None where all do.

    Raises:
        ValueError: the image is smaller than the 11-pixel window, or the mask leaves nothing.
    """
    if min(truth.shape[:2]) < MIN_SIDE:
        raise ValueError(f"SSIM needs {MIN_SIDE} pixels a side, the image has {truth.shape[:2]}")
    shown, true = np.clip(image, 0, 1).astype(np.float64), truth / 255.0
    if mask is not None:
        if not _cropped(mask).any():
            raise ValueError("SSIM of a mask that leaves no pixel off the border")
        shown = np.where(mask[..., None], shown, true)
    value, similarity = structural_similarity(
        shown, true, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0,
        channel_axis=-1, full=True)
    return float(value if mask is None else _cropped(similarity)[_cropped(mask)].mean())


def _cropped(pixels: NDArray[Any]) -> NDArray[Any]:
    """Returns [H, W, ...] without the border that SSIM leaves out."""
    return pixels[_BORDER:-_BORDER, _BORDER:-_BORDER]


_HEADINGS = ("model", "PSNR dB", "SSIM", "Gaussians", "MB", "ms/view", "train s")


def _cells(score: ModelScore) -> tuple[str, ...]:
    return (
        score.label, f"{score.psnr_db:.2f}", f"{score.ssim:.4f}", f"{score.gaussians:,}",
        f"{score.bytes / 1e6:.1f}", f"{score.render_ms:.0f}", f"{score.train_seconds:.0f}")


def text_table(scores: Sequence[ModelScore]) -> str:
    """Returns the models side by side for a terminal."""
    rows = [_HEADINGS, *(_cells(score) for score in scores)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADINGS))]
    lines = ["  ".join([row[0].ljust(widths[0]),
                        *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:],
                                                                   strict=True))])
             for row in rows]
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(lines)


def markdown_table(scores: Sequence[ModelScore]) -> str:
    """Returns the models side by side, then each view, in Markdown."""
    lines = ["| " + " | ".join(_HEADINGS) + " |", "|---" + "|---:" * (len(_HEADINGS) - 1) + "|"]
    lines += ["| " + " | ".join(_cells(score)) + " |" for score in scores]
    labels = [score.label for score in scores]
    lines += ["", "| view | " + " | ".join(f"PSNR dB {label}" for label in labels) + " | "
              + " | ".join(f"SSIM {label}" for label in labels) + " |",
              "|---" + "|---:" * (2 * len(labels)) + "|"]
    for views in zip(*(score.views for score in scores), strict=True):
        cells = [f"{v.psnr_db:.2f}" for v in views] + [f"{v.ssim:.4f}" for v in views]
        lines.append(f"| {views[0].name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def csv_table(scores: Mapping[str, ModelScore]) -> str:
    """Returns one row for each model and view, and one with the mean, as CSV."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["model", "view", "psnr_db", "ssim"])
    for key, score in scores.items():
        for view in score.views:
            writer.writerow([key, view.name, f"{view.psnr_db:.6f}", f"{view.ssim:.6f}"])
        writer.writerow([key, "mean", f"{score.psnr_db:.6f}", f"{score.ssim:.6f}"])
    return file.getvalue()
