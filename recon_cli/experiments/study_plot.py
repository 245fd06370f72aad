"""The paper's own figures: "3D Reconstruction of Indoor Scenes Based on 3DGS Models", Table I."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.experiments.study_result import ARMS, BASELINE, COMPARISONS, Result
from recon_cli.workspace import atomic

_APART = 0.18  # of the lines of two arms, where two scenes are 1 apart
_FIGURES = (("psnr_db", "PSNR dB against 3DGS"), ("ssim", "SSIM against 3DGS"))


def draw(result: Result, path: Path) -> None:
    """Draws means and intervals of every scene into a .png or .svg, whole or not at all.

    A cross is the gain that the paper reports for a scene of that name.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 2 + 1.4 * len(result.rows)), layout="constrained")
    panels = figure.subplots(len(_FIGURES), len(COMPARISONS), squeeze=False, sharey=True)
    for line, (name, label) in zip(panels, _FIGURES, strict=True):
        for axes, comparison in zip(line, COMPARISONS, strict=True):
            _panel(axes, result, comparison, name)
            axes.set(xlabel=label, title=comparison)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    figure.suptitle(f"{result.seeds} seeds, 95% intervals", fontsize=10)
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _panel(axes: Any, result: Result, comparison: str, figure: str) -> None:
    others = [arm for arm in ARMS if arm is not BASELINE]
    for number, arm in enumerate(others):
        found = [result.difference(row, comparison, arm, BASELINE, figure) for row in result.rows]
        reach = [0.0 if one.high is None else one.high - one.mean for one in found]
        axes.errorbar(
            [one.mean for one in found],
            [place + _APART * (number - 1) for place in range(len(found))], xerr=reach, fmt="o",
            markersize=4, capsize=3, label=arm.label, color=f"C{number}")
    for place, row in enumerate(result.rows):
        if (theirs := published(row)) is not None:
            gain = theirs.gain_db if figure == "psnr_db" else theirs.gain_ssim
            axes.plot(gain, place - _APART, "x", color="black")
    axes.axvline(0, color="0.6", linewidth=0.8, zorder=0)
    axes.set_yticks(range(len(result.rows)), result.rows)
    axes.set_ylim(len(result.rows) - 0.5, -0.5)
    axes.grid(axis="x", color="0.92")


@dataclass(frozen=True)
class Published:
    """One row of Table I (Replica).

    Attributes:
        reference_psnr_db: of 3DGS.
        reference_ssim: of 3DGS.
        paper_psnr_db: of the paper's method.
        paper_ssim: of the paper's method.
    """

    reference_psnr_db: float
    reference_ssim: float
    paper_psnr_db: float
    paper_ssim: float

    @property
    def gain_db(self) -> float:
        """What the paper reports to gain."""
        return self.paper_psnr_db - self.reference_psnr_db

    @property
    def gain_ssim(self) -> float:
        """What the paper reports to gain."""
        return self.paper_ssim - self.reference_ssim


TABLE_I = {
    "office0": Published(38.45, 0.925, 39.05, 0.934),
    "office1": Published(36.97, 0.938, 37.17, 0.954),
    "office2": Published(36.39, 0.945, 36.68, 0.962),
    "office3": Published(35.85, 0.941, 36.35, 0.958),
    "office4": Published(36.54, 0.939, 36.66, 0.941),
    "room0": Published(37.26, 0.915, 38.06, 0.923),
    "room1": Published(36.28, 0.929, 37.75, 0.935),
    "room2": Published(34.98, 0.913, 35.14, 0.927),
}


def published(scene: str) -> Published | None:
    """Returns the paper's figures for a scene of that name, None where it has none."""
    return TABLE_I.get(scene.lower())
