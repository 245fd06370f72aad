"""Tables of scores: models side by side, views, data sets."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

from recon_cli.metrics.scores import ModelScore
from recon_cli.tables import Table

_VIEW_FIELDS = ("psnr_db", "psnr_8bit_db", "ssim", "ssim_padded", "lpips")


def model_table(scores: Sequence[ModelScore]) -> Table:
    """Returns the models side by side; LPIPS has a column where one has it."""
    perceptual = any(score.lpips is not None for score in scores)
    headings = ("model", "PSNR dB", "8-bit", "SSIM", "SSIM 0-pad", *["LPIPS"] * perceptual,
                "Gaussians", "MB", "ms/view", "train s")
    return Table(headings, tuple((
        score.label, f"{score.psnr_db:.2f}", f"{score.psnr_8bit_db:.2f}", f"{score.ssim:.4f}",
        f"{score.ssim_padded:.4f}", *[_or_dash(score.lpips, ".4f")] * perceptual,
        f"{score.gaussians:,}", f"{score.bytes / 1e6:.1f}", f"{score.render_ms:.0f}",
        _or_dash(score.train_seconds, ".0f")) for score in scores))


def view_table(scores: Sequence[ModelScore]) -> Table:
    """Returns each view with the scores of all models, which have the same views."""
    labels = [score.label for score in scores]
    headings = ("view", *(f"{what} {label}" for what in ("PSNR dB", "SSIM") for label in labels))
    return Table(headings, tuple((
        views[0].name, *(f"{view.psnr_db:.2f}" for view in views),
        *(f"{view.ssim:.4f}" for view in views))
        for views in zip(*(score.views for score in scores), strict=True)))


def paper_table(sets: Mapping[str, tuple[ModelScore, ModelScore]]) -> Table:
    """Returns a row for each data set: 3DGS against ours, as the paper's tables I and II have it.

    Args:
        sets: (3DGS, ours) by the name of the data set.
    """
    return Table(
        ("data set", "PSNR 3DGS", "PSNR ours", "SSIM 3DGS", "SSIM ours"),
        tuple((name, f"{base.psnr_db:.2f}", f"{ours.psnr_db:.2f}", f"{base.ssim:.4f}",
               f"{ours.ssim:.4f}") for name, (base, ours) in sets.items()))


def csv_table(scores: Mapping[str, ModelScore]) -> str:
    """Returns one row for each model and view, and one with the mean, as CSV."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["model", "view", *_VIEW_FIELDS])
    for key, score in scores.items():
        for name, source in [*((view.name, view) for view in score.views), ("mean", score)]:
            writer.writerow([key, name, *(
                "" if value is None else f"{value:.6f}"
                for value in (getattr(source, field) for field in _VIEW_FIELDS))])
    return file.getvalue()


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
