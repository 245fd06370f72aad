"""`recon map-segment`, which `recon sfm` types for each segment of a long capture."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import verb
from recon_cli.lazy import load


@verb("map-segment")
@click.argument("job", type=options.PathType(exists=True, dir_okay=False))
def map_segment(job: Path) -> None:
    """Map one segment of a capture, as JOB says."""
    load("recon_cli.sfm.segments.map_segment")(job)
