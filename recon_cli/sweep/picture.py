"""A sweep as a picture: PSNR after recovery against the share removed. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from recon_cli import atomic
from recon_cli.sweep.measure import NONE, Trial


def draw(found: Sequence[Trial], before: float, path: Path) -> None:
    """Draws one line a score and the controls into a .svg, whole or not at all.

    Args:
        found: the trials of a sweep.
        before: PSNR of the model before it was pruned, dB.
        path: of the picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.subplots()
    for name in dict.fromkeys(one.score for one in found if one.score != NONE):
        axes.plot(*_line(found, name), marker="o", markersize=4, label=name)
    axes.plot(*_line(found, NONE), color="0.3", linestyle="--", label="no prune, equal seconds")
    for one in found:
        if one.score == NONE and one.ratio is None:
            axes.axhline(one.recovered.psnr_db, color="0.3", label="no prune, equal steps")
    axes.axhline(before, color="0.7", linestyle=":", label="before")
    axes.set(xlabel="share of the Gaussians that was removed",
             ylabel="PSNR on the validation views after recovery, dB")
    axes.legend(fontsize=8)
    axes.grid(color="0.92")
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary)


def _line(found: Sequence[Trial], name: str) -> tuple[list[float], list[float]]:
    """Returns ratios and PSNR of the trials of a name that belong to a ratio."""
    own = [(one.ratio, one.recovered.psnr_db)
           for one in found if one.score == name and one.ratio is not None]
    return [ratio for ratio, _ in own], [value for _, value in own]
