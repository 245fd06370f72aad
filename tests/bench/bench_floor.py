"""What the floors in notes/rasterizers.md are made of: `python tests/bench/bench_floor.py`.

Prints, for the room of `recon bench`, how many Gaussians are seen in how many instances, how many
pairs contribute, what the buffers of a training step take, and what one core copies.
"""

from __future__ import annotations

import time

import click
import numpy as np
import torch

from recon_cli.experiments.synthetic_room import room
from recon_cli.render import render
from recon_cli.render.contract import StepOptions, TargetImage
from recon_cli.render.numba.step import PhotometricStep

_COPIED = 200_000_000  # bytes; far more than any cache holds


def copy_gigabytes_per_second() -> float:
    """Returns what one core moves while it copies: read, fetched to be written, written."""
    source = np.ones(_COPIED, np.uint8)
    target = np.zeros_like(source)
    best = float("inf")
    for _ in range(7):
        start = time.perf_counter()
        target[:] = source
        best = min(best, time.perf_counter() - start)
    return 3 * _COPIED / best / 1e9


@click.command()
def main() -> None:
    """Print the counts."""
    splats, camera = room(100_000, 640, 360)
    black = torch.zeros(3)
    statistics = render(splats, camera, black, 3, backend="numba", scores=True).statistics
    step = PhotometricStep()
    truth = np.zeros((camera.height, camera.width, 3), np.uint8)
    step(splats, splats.map(torch.empty_like), camera, TargetImage(truth), StepOptions(3, 0.2))
    click.echo(f"seen            {int((statistics.radii > 0).sum()):,} Gaussians")
    click.echo(f"instances       {step.instances:,}")
    click.echo(f"contributing    {int(statistics.hits.sum()) / 1e6:.1f}M pairs")
    click.echo(f"buffers         {step.bytes / 1e6:.0f} MB")
    click.echo(f"one core moves  {copy_gigabytes_per_second():.0f} GB/s")


if __name__ == "__main__":
    main()
