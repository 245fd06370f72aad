"""The verb `recon bench train`: what can be asked of it. Torch is imported only when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, Command, pass_call
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.progress import TqdmProgress

_scene = click.Path(path_type=Path)


def scene_options(function: Command) -> Command:
    """Adds SCENE... as `more`, `--scenes`, and the size and cap of their runs."""
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
        function = decorator(function)
    return function


def compute_options(function: Command) -> Command:
    """Adds --set, device, backend, threads and -v."""
    for decorator in (
        options.verbosity(), options.of(ComputeConfig),
        options.assignments("ingest.frames=200"),
    ):
        function = decorator(function)
    return function


_file = click.Path(dir_okay=False, path_type=Path)


@click.command("train")
@scene_options
@click.option(
    "--recipes", multiple=True, metavar="NAME,...",
    help="reference, budget, mcmc, paper, budget-pruned, budget-l1 or budget-degree-1, each with "
         "options of training if wanted: budget+sh_degree=2.  [default: reference,budget,mcmc]")
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
    "--target-db", "targets", multiple=True, type=float, metavar="DB",
    help="PSNR whose time is told; may be repeated.  [default: what all runs of a scene reach]")
@click.option("--json", "json_file", type=_file, help="Write all figures to FILE.  "
              "[default: nowhere]")
@click.option(
    "--plot", type=_file,
    help="Draw the curves into a .png or .svg; needs recon-cli[plot].  [default: nowhere]")
@click.option(
    "--markdown", type=_file,
    help="Write the tables between the lines `<!-- recon bench: begin -->` and "
         "`<!-- recon bench: end -->` of FILE.  [default: nowhere]")
@compute_options
@pass_call
def train(
    call: Call, more: tuple[Path, ...], scenes: tuple[Path, ...], recipes: tuple[str, ...],
    iterations: int | None, seconds: float | None, seeds: int, targets: tuple[float, ...],
    max_size: int, max_gaussians: int, json_file: Path | None, plot: Path | None,
    markdown: Path | None,
) -> None:
    """Measure recipes of training: quality over time.

    Trains every recipe on every SCENE and writes curves of PSNR and SSIM on validation views
    against seconds, with the count and the size of the .ply.
    """
    from recon_cli.experiments.train_result import Request, base_config
    from recon_cli.experiments.train_run import run
    from recon_cli.experiments.variants import parse_all

    base = base_config(call.assigned, max_size=max_size, max_gaussians=max_gaussians)
    request = Request(
        (*scenes, *more), parse_all(recipes or ("reference,budget,mcmc",)), iterations, seconds,
        seeds, targets, base, call.assigned, settings.build(ComputeConfig, call.settings),
        json_file, plot, markdown)
    click.echo(run(request, TqdmProgress()))
