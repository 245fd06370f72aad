"""Speed against error as a picture. Needs matplotlib, which is imported only here."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.errors import ConfigError
from recon_cli.experiments.accuracy import Accuracy
from recon_cli.experiments.bench_result import Result, SceneResult
from recon_cli.workspace import atomic

_FORMATS = (".png", ".svg")
_FLOOR = 1e-9  # an error of zero has no place on a logarithmic axis


@dataclass(frozen=True)
class Point:
    """One candidate in the picture.

    Attributes:
        name: its label.
        ms: forward and backward.
        image_error: root mean square.
        gradient_error: relative.
    """

    name: str
    ms: float
    image_error: float
    gradient_error: float


def check_picture(path: Path) -> None:
    """Raises ConfigError unless a picture can be drawn into `path`."""
    if path.suffix.lower() not in _FORMATS:
        raise ConfigError(
            f"--plot is {path}, but it must end in .png or .svg.",
            hint=f"Try --plot {path.with_suffix('.svg').name}.")
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(
            "--plot needs matplotlib, which is not installed.",
            hint="pip install 'recon-cli[plot]'")


def points_of(scene: SceneResult) -> list[Point]:
    """Returns every backend, then every approximation that has a time.

    The backend that drew the approximations has the time that was taken in turn with theirs.
    """
    contract, *others = scene.variants
    found = []
    for name, one in scene.backends.items():
        ms = one.speed.forward.ms + one.speed.backward.ms
        if name == scene.variants_of and contract.time:
            ms = contract.time.ms
        found.append(_point(name, ms, one.accuracy))
    return found + [_point(one.name, one.time.ms, one.accuracy) for one in others if one.time]


def _point(name: str, ms: float, accuracy: Accuracy) -> Point:
    return Point(name, ms, accuracy.image_error_rms, accuracy.gradient_relative_error)


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Returns the points (ms, error) that no other beats in both, by rising milliseconds."""
    best, kept = float("inf"), []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < best:
            best = points[i][1]
            kept.append(i)
    return kept


def draw(result: Result, path: Path) -> None:
    """Draws the picture of the first scene into a .png or .svg, whole or not at all.

    Points bear numbers and the names stand beside: many lie on top of each other.
    """
    from matplotlib.figure import Figure

    name, scene = next(iter(result.scenes.items()))
    points = points_of(scene)
    figure = Figure(figsize=(15, 6), layout="constrained")
    left, right, names = figure.subplots(1, 3, width_ratios=(5, 5, 2))
    figure.suptitle(
        f"{name}: {scene.gaussians:,} Gaussians, {scene.width}x{scene.height}, "
        f"{result.host.cpu}, threads: {result.host.threads}", fontsize=10)
    _scatter(left, [(p.ms, p.image_error) for p in points], len(scene.backends))
    _scatter(right, [(p.ms, p.gradient_error) for p in points], len(scene.backends))
    left.set_ylabel("image error against float64, RMS")
    right.set_ylabel("gradient error against float64, relative")
    lines = [f"{i}  {point.name}" for i, point in enumerate(points, start=1)]
    names.text(0, 1, "\n".join(lines), va="top", fontsize=9, linespacing=1.6)
    names.axis("off")
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _scatter(axes: Any, places: Sequence[tuple[float, float]], backends: int) -> None:
    """Draws numbered points and a line through those that no other beats; backends come first."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    places = [(ms, max(error, _FLOOR)) for ms, error in places]
    axes.plot(*zip(*(places[i] for i in front(places)), strict=True), color="0.7", zorder=1)
    axes.scatter(*zip(*places, strict=True), zorder=2, s=16,
                 c=["C1" if i < backends else "C0" for i in range(len(places))])
    for number, place in enumerate(places, start=1):
        axes.annotate(str(number), place, xytext=(4, 3), textcoords="offset points", fontsize=8)
    axes.set(xscale="log", yscale="log", xlabel="forward + backward, ms")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="0.92")
