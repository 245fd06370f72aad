"""The verbs that need no workspace: convert and info."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config import settings as layers
from recon_cli.config.export import read_matrix
from recon_cli.config.stages import ComputeConfig
from recon_cli.errors import ConfigError, ReconError
from recon_cli.progress import TqdmProgress

if TYPE_CHECKING:  # they import torch
    from recon_cli.context import StageContext
    from recon_cli.scene.similarity import Similarity

_STAYS = "-"  # instead of a file of --transform

logger = logging.getLogger("recon")


@verb("convert")
@click.argument("paths", metavar="IN... OUT", nargs=-1, required=True, type=options.PathType())
@click.option(
    "--transform", "transforms", metavar="FILE.json", multiple=True,
    help="JSON file with a 4 x 4 matrix (rotation, translation, uniform scale); once for each IN, "
         "in their order, `-` for one that stays.  [default: all stay]")
@click.option(
    "--scale", type=click.FloatRange(0, min_open=True), metavar="X", default=1.0,
    show_default=True, help="Enlarge the scene this many times, after --transform.")
@click.option(
    "--up", type=click.Choice(["z", "y", "-y"]),
    help="Turn the scene so that this axis is up.  [default: as in the first IN]")
@click.option(
    "--drop-floaters", is_flag=True,
    help="Remove Gaussians that are too faint to be drawn, faint and large, or alone.  "
         "[default: off]")
@click.option(
    "--drop-islands", is_flag=True,
    help="Remove small groups of Gaussians far from all others.  [default: off]")
@click.option(
    "--crop", type=float, nargs=6, metavar="X Y Z X Y Z",
    help="Keep the box between two corners, in units of OUT.  [default: everything]")
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), metavar="N",
    help="Maximum degree of the spherical harmonics.  [default: that of the scene]")
@click.option(
    "--max-gaussians", type=click.IntRange(1), metavar="N",
    help="Merge neighbours until no more are left.  [default: no limit]")
@click.option(
    "--max-mb", type=click.FloatRange(0), metavar="X",
    help="Maximum size of OUT; degree and number of Gaussians are reduced.  [MB; default: no "
         "limit]")
@click.option(
    "--max-loss", type=click.FloatRange(0), metavar="X",
    help="Maximum loss of PSNR by the format.  [dB; default: as `recon export`]")
@click.option("--force", is_flag=True, help="Replace OUT if it exists.  [default: off]")
@options.compute()
@options.verbosity
@pass_call
def convert(
    call: Call, /, paths: tuple[Path, ...], transforms: tuple[str, ...], **changes: Any
) -> None:
    """Convert, merge and reduce splat files, without a workspace.

    The last name is the file to write, its ending the format.
    """
    if len(paths) < 2:
        raise click.UsageError("Missing argument 'OUT'.")
    from recon_cli.export.convert import ConvertRequest
    from recon_cli.export.convert import convert as write

    request = ConvertRequest(
        paths[:-1], paths[-1], tuple(map(_read_transform, transforms)), **changes)
    say(write(request, _context(call, light=not request.reduces)).describe())


@verb("info")
@click.argument("paths", metavar="FILE...", nargs=-1, required=True, type=options.PathType())
@click.option("--json", "as_json", is_flag=True, help="Print a JSON list.  [default: off]")
@options.compute()
@options.verbosity
@pass_call
def info(call: Call, paths: tuple[Path, ...], as_json: bool) -> None:
    """Describe splat files: what they hold, and what is wrong with them."""
    from recon_cli.export.describe_file import FileFindings, describe_file

    ctx, found, errors = _context(call, light=True), list[FileFindings](), list[ReconError]()
    for path in paths:
        try:
            found.append(describe_file(path, ctx))
        except ReconError as error:
            errors.append(error)
    if as_json:
        say(json.dumps([dataclasses.asdict(one) for one in found], indent=1))
    elif found:
        say("\n\n".join(one.describe() for one in found))
    _raise_last(errors)


def _raise_last(errors: Sequence[ReconError]) -> None:
    """Raises the last error, after notices of the others."""
    for error in errors[:-1]:
        logger.warning("%s", error.message)
    if errors:
        raise errors[-1]


def _read_transform(name: str) -> Similarity:
    import numpy as np

    from recon_cli.scene.similarity import Similarity

    if name == _STAYS:
        return Similarity()
    try:
        return Similarity.from_matrix(np.array(read_matrix(name)).reshape(4, 4))
    except ValueError as error:
        raise ConfigError(
            f"The matrix in {name} cannot be used: {error}.",
            hint="It must be a rotation times one scale above 0, with a translation in its last "
            "column.") from error


def _context(call: Call, *, light: bool) -> StageContext:
    from recon_cli.pipeline.execute import light_context, render_context

    context = light_context if light else render_context
    return context(layers.build(ComputeConfig, call.settings), TqdmProgress())
