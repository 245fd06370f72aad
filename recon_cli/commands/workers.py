"""Commands that recon types itself, for each segment of a capture and each block of a scene."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.progress import NullProgress


@verb("map-segment")
@click.argument("job", type=options.PathType(exists=True, dir_okay=False))
def map_segment(job: Path) -> None:
    """Map one segment of a capture, as JOB says."""
    from recon_cli.sfm.segments import segments

    segments.map_segment(job)


@verb("train-block")
@click.argument("job", type=options.PathType(exists=True, dir_okay=False))
@options.compute(trains=True)
@pass_call
def train_block(call: Call, job: Path) -> None:
    """Train one block of a scene, as JOB says."""
    from recon_cli.pipeline.execute import render_context
    from recon_cli.train.blocks import blocks

    blocks.train_block(
        job, render_context(settings.build(ComputeConfig, call.settings), NullProgress()))
