"""The differences from 3DGS as a picture. Needs matplotlib, which is imported only here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recon_cli import atomic
from recon_cli.study.published import published
from recon_cli.study.request import ARMS, BASELINE, COMPARISONS
from recon_cli.study.result import Result

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
