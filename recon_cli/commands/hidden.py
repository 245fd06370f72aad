"""Verbs that recon types itself: the jobs that a stage shares out."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.lazy import load
from recon_cli.pipeline.execute import render_context
from recon_cli.progress import NullProgress

_job = click.argument("job", type=options.PathType(exists=True, dir_okay=False))


@verb("map-segment")
@_job
def map_segment(job: Path) -> None:
    """Map one segment of a capture, as JOB says."""
    load("recon_cli.sfm.segments.map_segment")(job)


@verb("train-block")
@_job
@options.compute(trains=True)
@pass_call
def train_block(call: Call, job: Path) -> None:
    """Train one block of a scene, as JOB says."""
    ctx = render_context(settings.build(ComputeConfig, call.settings), NullProgress())
    load("recon_cli.train.blocks.train_block")(job, ctx)
