"""Trains recipes on scenes and prints curves of quality over time: `python bench_curves.py --help`.

SCENES are workspaces with cameras, or data sets with poses. Each recipe is trained with several
seeds and scored on validation views along the way, for equal steps or equal seconds.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from recon_cli.config.settings import build, parse_assignment
from recon_cli.config.stages import ComputeConfig, RunConfig
from recon_cli.evaluation.scores import Table
from recon_cli.experiments.instruments import Host, Timing
from recon_cli.experiments.outputs import Result, add_legend, drawing
from recon_cli.experiments.runner import (
    FIGURES,
    STEPS,
    CurvePoint,
    ExperimentRequest,
    Runner,
    SceneRuns,
    base_config,
    shared_options,
)
from recon_cli.experiments.scenes import LoadedScene, check_scenes
from recon_cli.experiments.variants import (
    BUDGET,
    BUDGET_PRUNED,
    PAPER,
    REFERENCE,
    Variant,
)
from recon_cli.progress import Progress, TqdmProgress

KNOWN = {variant.name: variant for variant in (
    REFERENCE, PAPER, BUDGET, BUDGET_PRUNED,
    Variant("budget-l1", "budget-l1", {"densify": "budget", "ssim_weight": 0.0}, tries_degree=True),
    Variant("budget-degree-1", "budget-degree-1", {"densify": "budget", "sh_degree": 1}))}
ALL = "all"  # the only comparison
_SCORES = 20  # along a run: each is of all validation views
_INCH = 3.2  # of a panel

_PANELS = (  # figures across and up
    ("seconds", "psnr_db"), ("cpu_seconds", "psnr_db"), ("seconds", "ssim"),
    ("cpu_seconds", "ssim"), ("seconds", "gaussians"), ("seconds", "megabytes"))
_CLOCKS = ("seconds", "cpu_seconds")


@dataclass(frozen=True, kw_only=True)
class RecipeRequest(ExperimentRequest):
    """The options of a run."""

    recipes: tuple[Variant, ...]
    iterations: int = STEPS  # of every run
    seconds: float | None = None  # of every run instead
    targets_db: tuple[float, ...] = ()  # PSNR to reach; empty for that of all runs

    def steps(self, seconds_per_step: float) -> int:
        """Returns the steps of every run of a recipe."""
        if self.seconds is None:
            return self.iterations
        return max(1, round(self.seconds / max(seconds_per_step, 1e-12)))


@dataclass(frozen=True)
class CurvesResult:
    """A run of the benchmark."""

    host: Host
    seeds: int
    base: RunConfig
    targets_db: tuple[float, ...]  # of the command line
    recipes: tuple[Variant, ...]
    scenes: Mapping[str, SceneRuns]

    def targets_of(self, scene: SceneRuns) -> tuple[float, ...]:
        """Returns the targets of the command line, or the PSNR that all runs of a scene reach."""
        return self.targets_db or (common_target(
            [record.points for records in scene.runs[ALL].values() for record in records]),)

    def record(self) -> dict[str, Any]:
        """Returns the content of the JSON file."""
        return {
            "schema": "recon-bench-train", "version": 1, "machine": asdict(self.host),
            "seeds": self.seeds, "base": shared_options(self.base),
            "scenes": {name: {
                **scene.size_record(),
                "recipes": {recipe.name: self._recipe(scene, recipe) for recipe in self.recipes},
            } for name, scene in self.scenes.items()}}

    def _recipe(self, scene: SceneRuns, recipe: Variant) -> dict[str, Any]:
        records, targets = scene.runs[ALL][recipe.name], self.targets_of(scene)
        return {
            **recipe.record(), "iterations": records[0].last.iteration,
            **{f"{clock}_to": {
                f"{db:g}": [seconds_to(record.points, db, clock) for record in records]
                for db in targets} for clock in _CLOCKS},
            "runs": [{"seed": seed, "points": [asdict(point) for point in record.points]}
                     for seed, record in enumerate(records)]}


def run(request: RecipeRequest, progress: Progress) -> Result:
    """Trains every recipe and returns the result."""
    paths = check_scenes(request.scenes)
    runner = Runner(request.base, progress)
    with tempfile.TemporaryDirectory(prefix="recon-bench-") as scratch:
        host, loading = request.load(paths, Path(scratch), "validation", progress)
        curves = CurvesResult(
            host, request.seeds, request.base, request.targets_db, request.recipes,
            {loaded.folders.name: measure(loaded, request, runner) for loaded in list(loading)})
    return Result(
        curves.record(), head(curves), tables(curves), draw=lambda path: draw(curves, path))


def measure(loaded: LoadedScene, request: RecipeRequest, runner: Runner) -> SceneRuns:
    """Returns the curves of every recipe; pilots warm caches, and turn seconds into steps."""
    seconds = runner.pilot_seconds(loaded, request.recipes)
    steps = {name: request.steps(seconds_per_step) for name, seconds_per_step in seconds.items()}
    runs = runner.run_all(
        loaded, request.recipes, request.seeds, steps, label=loaded.folders.name,
        score_at=score_steps)
    return SceneRuns.from_loaded(loaded, {ALL: runs})


def score_steps(iterations: int, count: int = _SCORES) -> tuple[int, ...]:
    """Returns the steps to score after: 0, and `count` evenly spread ones up to the last."""
    return tuple(sorted({round(i * iterations / count) for i in range(count + 1)}))


def seconds_to(points: Sequence[CurvePoint], target_db: float, clock: str) -> float | None:
    """Returns when a curve first reaches a PSNR, by linear interpolation, or None."""
    psnr_db = [point.psnr_db for point in points]
    end = next((i for i, value in enumerate(psnr_db) if value >= target_db), None)
    if end is None:
        return None
    seconds = [FIGURES[clock].value(point) for point in points]
    start = max(0, end - 1)
    return float(np.interp(target_db, psnr_db[start:end + 1], seconds[start:end + 1]))


def common_target(runs: Sequence[Sequence[CurvePoint]]) -> float:
    """Returns the PSNR that every run reaches, rounded down to a tenth of a dB."""
    best = min(max(point.psnr_db for point in points) for points in runs)
    return math.floor(10 * best) / 10


def head(result: CurvesResult) -> str:
    """Returns the line about machine and method above the tables."""
    return (f"{result.host.line}; medians of {result.seeds} seeds, interquartile range in "
            "brackets; scored on validation views, scoring not timed")


def tables(result: CurvesResult) -> list[Table]:
    """Returns one table a scene."""
    return [_table(name, scene, result) for name, scene in result.scenes.items()]


def median_cell(values: Sequence[float | None], digits: int = 3) -> str:
    """Returns median and interquartile range; "-" where half of the runs have no value."""
    known = [value for value in values if value is not None]
    if 2 * len(known) <= len(values):
        return "-"
    cell = Timing.from_samples(known).text(digits)
    return cell if len(known) == len(values) else f"{cell}, {len(known)} of {len(values)}"


def _table(name: str, scene: SceneRuns, result: CurvesResult) -> Table:
    targets = result.targets_of(scene)
    header = ("recipe", *(f"{FIGURES[clock].label} to {db:g} dB"
                          for db in targets for clock in _CLOCKS), *(
        figure.label for figure in FIGURES.values()))

    def row(recipe: str) -> tuple[str, ...]:
        records = scene.runs[ALL][recipe]
        reached = [median_cell([seconds_to(record.points, db, clock) for record in records])
                   for db in targets for clock in _CLOCKS]
        return (recipe, *reached, *(
            median_cell([figure.value(record.last) for record in records],
                        4 if name == "psnr_db" else 3) for name, figure in FIGURES.items()))

    title = (f"{name}: {scene.views} validation views at {scene.width}x{scene.height}, "
             f"at most {result.base.max_gaussians:,} Gaussians")
    return Table(header, [row(recipe) for recipe in scene.runs[ALL]], title)


def draw(result: CurvesResult, path: Path) -> None:
    """Draws each scene into a .png or .svg: median over the seeds, band from lowest to highest."""
    rows = len(result.scenes)
    with drawing(path, _INCH * len(_PANELS), _INCH * rows + 0.5) as figure:
        panels = figure.subplots(rows, len(_PANELS), squeeze=False)
        for line, (name, scene) in zip(panels, result.scenes.items(), strict=True):
            for axes, panel in zip(line, _PANELS, strict=True):
                across, up = (FIGURES[name] for name in panel)
                for recipe, records in scene.runs[ALL].items():
                    x, y = (np.array([[figure.value(point) for point in record.points]
                                      for record in records]) for figure in (across, up))
                    curve, = axes.plot(
                        np.median(x, axis=0), np.median(y, axis=0), label=recipe, linewidth=1.2)
                    axes.fill_between(np.median(x, axis=0), y.min(axis=0), y.max(axis=0),
                                      color=curve.get_color(), alpha=0.2)
                axes.set(xlabel=across.label, ylabel=up.label)
                axes.grid(color="0.92")
            line[0].set_title(name, fontsize=10)
        add_legend(figure, panels[0][0])
        figure.suptitle(f"{result.host.cpu}, threads: {result.host.threads}", fontsize=9)


def parse_recipe(text: str) -> Variant:
    """Returns the variant of `NAME` or `NAME+FIELD=VALUE+...`."""
    name, *changes = text.split("+")
    options: dict[str, Any] = {}
    for change in changes:
        options.update(parse_assignment(f"train.{change}")["train"])
    known = KNOWN[name]
    return Variant(text, text if changes else known.name, {**known.options, **options}, known.prune,
                   known.tries_degree and "sh_degree" not in options)


@click.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--recipes", default="reference,budget", show_default=True,
              help=f"Of {', '.join(KNOWN)}; with changed options: budget+sh_degree=2.")
@click.option("--iterations", type=int, default=STEPS, show_default=True)
@click.option("--seconds", type=float, help="As many steps as fit, by a short pilot.")
@click.option("--seeds", type=int, default=3, show_default=True)
@click.option("--target-db", "targets_db", multiple=True, type=float)
@click.option("--max-size", type=int, default=600, show_default=True)
@click.option("--max-gaussians", type=int, default=60_000, show_default=True)
@click.option("--threads", type=int)
@click.option("--plot", type=click.Path(path_type=Path), help="A .png or .svg.")
def main(scenes, recipes, max_size, max_gaussians, threads, plot, **typed) -> None:
    """Prints the curves of RECIPES on SCENES."""
    result = run(RecipeRequest(
        **typed, scenes=scenes, settings={}, compute=build(ComputeConfig, {
            "compute": {} if threads is None else {"threads": threads}}),
        base=base_config({}, max_size=max_size, max_gaussians=max_gaussians),
        recipes=tuple(map(parse_recipe, recipes.split(",")))), TqdmProgress())
    click.echo(result.text())
    if plot is not None:
        result.draw(plot)


if __name__ == "__main__":
    main()
