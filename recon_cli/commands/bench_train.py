"""`recon bench train`: the options of the recipe benchmark, and those that `recon study` shares."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, Command, pass_call
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.experiments.outputs import OutputFiles
from recon_cli.lazy import load
from recon_cli.progress import TqdmProgress

_file = click.Path(dir_okay=False, path_type=Path)
_scene = click.Path(path_type=Path)


@dataclass(frozen=True)
class SceneOptions:
    """The scenes of a training experiment, and the size and cap of their runs."""

    paths: tuple[Path, ...]
    max_size: int
    max_gaussians: int

    def fields(self, call: Call, *, validation: float | None = None) -> dict[str, Any]:
        """Returns the fields of an ExperimentRequest; `validation` as of `runner.base_config`."""
        base_config = load("recon_cli.experiments.runner.base_config")
        return {
            "scenes": self.paths, "settings": call.assigned,
            "compute": settings.build(ComputeConfig, call.settings),
            "base": base_config(call.assigned, max_size=self.max_size,
                                max_gaussians=self.max_gaussians, validation=validation)}


def scene_options(function: Command) -> Command:
    """Adds SCENE..., `--scenes`, and the size and cap of their runs as one `scenes`."""
    @functools.wraps(function)
    def collect(
        *args: Any, more: tuple[Path, ...], scenes: tuple[Path, ...], max_size: int,
        max_gaussians: int, **typed: Any,
    ) -> Any:
        collected = SceneOptions((*scenes, *more), max_size, max_gaussians)
        return function(*args, scenes=collected, **typed)

    for decorator in (
        click.option(
            "--max-gaussians", type=click.IntRange(min=1), default=60_000, metavar="N",
            help="Cap of the count.  [default: 60000]"),
        click.option(
            "--max-size", type=click.IntRange(min=16), default=600, metavar="N",
            help="Longest side of the images.  [pixels; default: 600]"),
        click.option(
            "--scenes", multiple=True, type=_scene, metavar="SCENE...",
            help="Workspaces with cameras, or data sets with poses; the words after it are scenes "
                 "too.  [default: none]"),
        click.argument("more", metavar="[SCENE]...", nargs=-1, type=_scene),
    ):
        collect = decorator(collect)
    return collect


def compute_options(function: Command) -> Command:
    """Adds --set, device, backend, threads and -v."""
    for decorator in (
        options.verbosity, options.of(ComputeConfig),
        options.assignments("ingest.frames=200"),
    ):
        function = decorator(function)
    return function


def output_options(plot: str) -> Callable[[Command], Command]:
    """Returns a decorator that adds --json, --plot and --markdown as one `outputs`."""
    def decorate(function: Command) -> Command:
        @functools.wraps(function)
        def collect(
            *args: Any, json_file: Path | None, plot: Path | None, markdown: Path | None,
            **typed: Any,
        ) -> Any:
            return function(*args, outputs=OutputFiles(json_file, plot, markdown), **typed)

        for decorator in (
            click.option(
                "--markdown", type=_file,
                help="Write the tables between the lines `<!-- recon bench: begin -->` and "
                     "`<!-- recon bench: end -->` of FILE.  [default: nowhere]"),
            click.option("--plot", type=_file, help=(
                f"{plot} into a .png or .svg; needs recon-cli[plot].  [default: nowhere]")),
            click.option("--json", "json_file", type=_file,
                         help="Write all figures to FILE.  [default: nowhere]"),
        ):
            collect = decorator(collect)
        return collect

    return decorate


@click.command("train")
@scene_options
@click.option(
    "--recipes", multiple=True, metavar="NAME,...",
    help="reference, budget, paper, budget-pruned, budget-l1 or budget-degree-1, each with "
         "options of training if wanted: budget+sh_degree=2.  [default: reference,budget]")
@click.option(
    "--iterations", type=click.IntRange(min=1), metavar="N",
    help="Steps of every run.  [default: 3000]")
@click.option(
    "--seconds", type=click.FloatRange(min=0, min_open=True), metavar="X",
    help="As many steps as fit, by the steps of a short pilot.  [default: --iterations counts]")
@click.option(
    "--seeds", type=click.IntRange(min=1), default=3, metavar="N",
    help="Runs of each recipe, with seeds 0 to N - 1.  [default: 3]")
@click.option(
    "--target-db", "targets_db", multiple=True, type=float, metavar="DB",
    help="PSNR whose time is reported; may be repeated.  [default: what all runs of a scene "
         "reach]")
@output_options("Draw the curves")
@compute_options
@pass_call
def train(call: Call, /, scenes: SceneOptions, recipes: tuple[str, ...], **typed: Any) -> None:
    """Measure recipes of training: quality over time.

    Trains every recipe on every SCENE and writes curves of PSNR and SSIM on validation views
    against seconds, with the count and the size of the .ply.
    """
    parse = load("recon_cli.experiments.variants.parse_recipes")
    request = load("recon_cli.experiments.recipe_benchmark.RecipeRequest")
    run = load("recon_cli.experiments.recipe_benchmark.run")
    shared = scenes.fields(call)
    variants = parse(recipes or ("reference,budget",))
    click.echo(run(request(**shared, **typed, recipes=variants), TqdmProgress()))
