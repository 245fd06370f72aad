"""The verb `recon bench train`: what can be asked of it. Torch is imported only when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli import settings
from recon_cli.bench.training import flags
from recon_cli.config import ComputeConfig
from recon_cli.options import Call, pass_call
from recon_cli.progress import TqdmProgress

_file = click.Path(dir_okay=False, path_type=Path)


@click.command("train")
@flags.scenes
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
@flags.settings
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
    from recon_cli.bench.training.arms import parse_all
    from recon_cli.bench.training.request import Request, base_config
    from recon_cli.bench.training.run import run

    base = base_config(call.assigned, max_size=max_size, max_gaussians=max_gaussians)
    request = Request(
        (*scenes, *more), parse_all(recipes or ("reference,budget,mcmc",)), iterations, seconds,
        seeds, targets, base, call.assigned, settings.build(ComputeConfig, call.settings),
        json_file, plot, markdown)
    click.echo(run(request, TqdmProgress()))
