"""The options that every verb has which trains on many scenes."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli import options
from recon_cli.config import ComputeConfig
from recon_cli.options import Command

_scene = click.Path(path_type=Path)


def scenes(function: Command) -> Command:
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


def settings(function: Command) -> Command:
    """Adds --set, device, backend, threads and -v."""
    for decorator in (
        options.verbosity(), options.of(ComputeConfig),
        options.assignments("ingest.frames=200"),
    ):
        function = decorator(function)
    return function
