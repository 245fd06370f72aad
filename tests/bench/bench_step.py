"""What a step of training takes on a finished model: `python tests/bench/bench_step.py WORKSPACE`.

Rates are zero, so that every step meets the same Gaussians. Run it with two checkouts in turn, on
one workspace, to compare them.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path

import click

from recon_cli.context import StageContext
from recon_cli.io.training_scene import load_scene
from recon_cli.render.registry import use_threads
from recon_cli.train.fit import fit
from recon_cli.train.initialize import restore_state
from recon_cli.train.schedule import Schedule
from recon_cli.train.train_data import load_task, read_config

_LENGTH = 1_000_000  # of the run that the steps are taken from: the schedule stands still
_WARM, _STEPS, _ROUNDS = 20, 40, 5
# share of the run, in `budget`: images at half size; statistics for densification; none
_PHASES = {"half size": 0.2, "with statistics": 0.45, "without": 0.7}


@click.command()
@click.argument("workspace", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--threads", default=2, show_default=True)
def main(workspace: Path, threads: int) -> None:
    """Print milliseconds of a step in three phases of a run."""
    use_threads("numba", threads)
    ctx = StageContext(backend="numba", threads=threads)
    scene = load_scene(
        {name: workspace / name for name in ("ingest", "sfm")}, validation=0.05)
    config = dataclasses.replace(
        read_config(workspace / "train"), iterations=_LENGTH, densify_every=2 * _LENGTH,
        early_stop=False, means_rate=0.0, quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0,
        sh_rate=0.0)
    task = dataclasses.replace(load_task(scene, config, ctx), validation=[])
    task = dataclasses.replace(task, schedule=Schedule(config))
    click.echo("| phase | Gaussians | ms a step |\n|---|---:|---:|")
    for name, share in _PHASES.items():
        state = restore_state(workspace / "train" / "final.safetensors", task)
        state.iteration = first = round(share * _LENGTH)
        fit(state, task, first + _WARM)
        times = []
        for index in range(_ROUNDS):
            begin = time.perf_counter()
            fit(state, task, first + _WARM + (index + 1) * _STEPS)
            times.append(1e3 * (time.perf_counter() - begin) / _STEPS)
        click.echo(f"| {name} | {len(state.splats):,} | {statistics.median(times):.1f} |")


if __name__ == "__main__":
    main()
