"""The verb `recon bench`: what can be asked of it. Torch is imported only when it runs."""

from __future__ import annotations

from pathlib import Path

import click
from click.core import ParameterSource

from recon_cli.commands import options
from recon_cli.commands.bench_train import train
from recon_cli.commands.options import Call, pass_call
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.experiments.bench_run import Request
from recon_cli.progress import TqdmProgress

_file = click.Path(dir_okay=False, path_type=Path)


@click.group("bench", invoke_without_command=True, subcommand_metavar="[train ...]")
@click.option(
    "--scene", type=click.Choice(["room", "small"]), default="room",
    help="room is 100,000 Gaussians at 640x360, small 10,000 at 320x180.  [default: room]")
@click.option(
    "--gaussians", type=click.IntRange(min=1), metavar="N",
    help="How many Gaussians.  [default: of the scene]")
@click.option("--size", metavar="WxH", help="Size of the image in pixels.  "
              "[default: of the scene]")
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), default=3, metavar="N",
    help="Degree of the spherical harmonics.  [default: 3]")
@click.option(
    "--backend", "backends", multiple=True, metavar="NAME",
    help="Rasterizer to measure; may be repeated.  [default: all that run on the device]")
@options.of(ComputeConfig, without=("backend",))
@click.option(
    "--rounds", type=click.IntRange(min=1), metavar="N",
    help="Runs behind each median.  [default: 7, with --quick 2]")
@click.option(
    "--quick", is_flag=True,
    help="A tiny scene and few rounds: whether it works, not how fast.  [default: off]")
@click.option("--json", "json_file", type=_file, help="Write all figures to FILE.  "
              "[default: nowhere]")
@click.option(
    "--plot", type=_file,
    help="Draw speed against error into a .png or .svg; needs recon-cli[plot].  "
         "[default: nowhere]")
@click.option(
    "--markdown", type=_file,
    help="Write the tables between the lines `<!-- recon bench: begin -->` and "
         "`<!-- recon bench: end -->` of FILE.  [default: nowhere]")
@click.option(
    "--compare", type=_file,
    help="Print the ratio of each figure of an earlier --json FILE to this run's.  "
         "[default: none]")
@options.verbosity()
@pass_call
@click.pass_context
def bench(
    ctx: click.Context, call: Call, scene: str, gaussians: int | None, size: str | None,
    sh_degree: int, backends: tuple[str, ...], rounds: int | None, quick: bool,
    json_file: Path | None, plot: Path | None, markdown: Path | None, compare: Path | None,
) -> None:
    """Measure the rasterizers: speed against error.

    Times every stage on a synthetic room and compares images and gradients with a rasterizer in
    float64, for every backend and for approximations of it. `recon bench train` measures recipes
    of training instead.
    """
    if ctx.invoked_subcommand is not None:
        _refuse_own_options(ctx)
        return
    from recon_cli.experiments.bench_run import run

    compute = settings.build(ComputeConfig, call.settings)
    request = Request(
        scene, gaussians, size, sh_degree, backends, compute.device, compute.threads, rounds,
        quick, json_file, plot, markdown, compare)
    click.echo(run(request, TqdmProgress()))


def _refuse_own_options(ctx: click.Context) -> None:
    """Raises UsageError where an option of `recon bench` stands before a subcommand."""
    for parameter in ctx.command.params:
        if ctx.get_parameter_source(parameter.name or "") is ParameterSource.COMMANDLINE:
            raise click.UsageError(
                f"{parameter.opts[0]} has no effect on {ctx.invoked_subcommand}.", ctx)


bench.add_command(train)
