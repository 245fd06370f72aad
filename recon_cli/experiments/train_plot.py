"""The curves as a picture. Needs matplotlib, which is imported only here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recon_cli.experiments.train_result import ArmResult, Result
from recon_cli.experiments.trial import Point
from recon_cli.workspace import atomic

Axis = tuple[str, Callable[[Point], float]]
_WALL: Axis = ("wall s", lambda point: point.seconds)
_CPU: Axis = ("CPU s", lambda point: point.cpu_seconds)
_PSNR: Axis = ("PSNR dB", lambda point: point.psnr_db)
_SSIM: Axis = ("SSIM", lambda point: point.ssim)
_COUNT: Axis = ("thousand Gaussians", lambda point: point.gaussians / 1e3)
_SIZE: Axis = ("MB", lambda point: point.bytes / 1e6)
_PANELS: tuple[tuple[Axis, Axis], ...] = (
    (_WALL, _PSNR), (_CPU, _PSNR), (_WALL, _SSIM), (_CPU, _SSIM), (_WALL, _COUNT), (_WALL, _SIZE))
_INCH = 3.2  # of a panel


def draw(result: Result, path: Path) -> None:
    """Draws a row of panels a scene into a .png or .svg, whole or not at all.

    A line is the median over the seeds; the band reaches from the lowest to the highest.
    """
    from matplotlib.figure import Figure

    rows = len(result.scenes)
    figure = Figure(
        figsize=(_INCH * len(_PANELS), _INCH * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, len(_PANELS), squeeze=False)
    for line, (name, scene) in zip(panels, result.scenes.items(), strict=True):
        for axes, (across, up) in zip(line, _PANELS, strict=True):
            for one in scene.arms.values():
                _curve(axes, one, across, up)
            axes.set(xlabel=across[0], ylabel=up[0])
            axes.grid(color="0.92")
        line[0].set_title(name, fontsize=10)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    figure.suptitle(f"{result.host.cpu}, threads: {result.host.threads}", fontsize=9)
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _curve(axes: Any, one: ArmResult, across: Axis, up: Axis) -> None:
    """Draws the runs of a recipe, whose points were taken after the same steps."""
    x = np.median(_table(one, across[1]), axis=0)
    y = _table(one, up[1])
    line, = axes.plot(x, np.median(y, axis=0), label=one.arm.name, linewidth=1.2)
    axes.fill_between(x, y.min(axis=0), y.max(axis=0), color=line.get_color(), alpha=0.2)


def _table(one: ArmResult, figure: Callable[[Point], float]) -> Any:
    rows: Sequence[Sequence[float]] = [
        [figure(point) for point in run.points] for run in one.runs]
    return np.array(rows)
