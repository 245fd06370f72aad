"""`recon bench`: the options of the rasterizer benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from recon_cli.commands import options
from recon_cli.commands.bench_train import output_options, train
from recon_cli.commands.options import Call, pass_call
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.experiments.outputs import OutputFiles
from recon_cli.lazy import load
from recon_cli.progress import TqdmProgress


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
@output_options("Draw speed against error")
@click.option(
    "--compare", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
    help="Print the ratio of each figure of an earlier --json FILE to this run's.  "
         "[default: none]")
@options.verbosity
@pass_call
@click.pass_context
def bench(ctx: click.Context, call: Call, /, outputs: OutputFiles, **typed: Any) -> None:
    """Measure the rasterizers: speed against error.

    Times every stage on a synthetic room and compares images and gradients with a rasterizer in
    float64, for every backend and for approximations of it. `recon bench train` measures recipes
    of training instead.
    """
    if ctx.invoked_subcommand is not None:
        _refuse_own_options(ctx)
        return
    compute = settings.build(ComputeConfig, call.settings)
    request = load("recon_cli.experiments.rasterizer_benchmark.BenchRequest")
    run = load("recon_cli.experiments.rasterizer_benchmark.run")
    click.echo(run(
        request(**typed, outputs=outputs, device=compute.device, threads=compute.threads),
        TqdmProgress()))


def _refuse_own_options(ctx: click.Context) -> None:
    """Raises UsageError where an option of `recon bench` stands before a subcommand."""
    for parameter in ctx.command.params:
        if ctx.get_parameter_source(parameter.name or "") is ParameterSource.COMMANDLINE:
            raise click.UsageError(
                f"{parameter.opts[0]} has no effect on {ctx.invoked_subcommand}.", ctx)


bench.add_command(train)
