"""`recon train-block`, which `recon train` types for each block of a large scene."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.pipeline.execute import render_context
from recon_cli.progress import NullProgress
from recon_cli.train import blocks


@verb("train-block")
@click.argument("job", type=options.PathType(exists=True, dir_okay=False))
@options.compute(trains=True)
@pass_call
def train_block(call: Call, job: Path) -> None:
    """Train one block of a scene, as JOB says."""
    blocks.train_block(
        job, render_context(settings.build(ComputeConfig, call.settings), NullProgress()))
