"""How well the time of a training is told before it starts, on posed workspaces.

    python tests/bench/bench_estimate.py WORKSPACE... [--minutes 0.25 --minutes 1] [--quality draft]
        [--threads 1] [--clock cpu]

Each workspace needs a finished sfm. The parts of the model are fixed, harmonics of degree 3 and far
content; the last column is what steps took over what the cost model says of them. `--clock cpu`
plans and measures by the CPU time of this process: with one thread that is what a machine with
nothing else to do takes, whatever others run on this one. `--clock wall` is what a user sees.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import click
import numpy as np

from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.io.training_scene import load_scene
from recon_cli.render import registry
from recon_cli.train import plan
from recon_cli.train.cost import CostModel, calibrate
from recon_cli.train.initialize import first_state
from recon_cli.train.plan import first_count
from recon_cli.train.runner import LOG, Segment, run_fit
from recon_cli.train.schedule import Schedule
from recon_cli.train.train_data import gaussians_that_fit, load_task
from recon_cli.workspace.summaries import LogRow

_PHASES = 5
CLOCKS = {"cpu": time.process_time, "wall": time.perf_counter}


def row(workspace: Path, config: TrainConfig, ctx: StageContext, clock: str) -> str:
    """Plans and runs one training and returns its line of the table."""
    now = CLOCKS[clock]
    inputs = StageInputs({name: workspace / name for name in ("ingest", "sfm")})
    scene = load_scene(inputs.folders, validation=config.validation)
    first = plan.first_config(config)
    task = load_task(scene, first, ctx)
    facts = plan.Facts(plan.count_detail(task.train), len(task.train), len(scene.points),
                       gaussians_that_fit(scene, first, ctx))
    seconds = (plan.CALIBRATION_SECONDS if config.minutes is None
               else plan.CALIBRATION_SHARE * 60 * config.minutes)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        probe = Schedule(plan.probe_config(config, facts))
        cost = calibrate(
            dataclasses.replace(task, schedule=probe), scene.points, scene.colors,
            scratch=out / "calibration.safetensors", clock=now, seconds=seconds)
        made = plan.make_plan(config, facts, cost)
        schedule = Schedule(plan.run_config(config, made))
        task = dataclasses.replace(task, schedule=schedule)
        state = first_state(task, scene.points, scene.colors,
                            most=first_count(schedule.config, len(scene.points)))
        begin = now()
        run_fit(state, task, made.iterations, Segment(out, "train", made.iterations), ctx)
        took = now() - begin
        phases = list(_phases(LogRow.read_all(out / LOG), cost, schedule, clock))
    asked = config.quality if config.minutes is None else f"{config.minutes:g} min"
    return (f"| {workspace.name} | {asked} | {made.iterations:,} | {len(state.splats):,} | "
            f"{cost.seconds:.2f} | {made.seconds:.1f} | {took:.1f} | "
            f"{100 * (made.seconds / took - 1):+.0f}% | "
            f"{' '.join(f'{ratio:.2f}' for ratio in phases)} |")


def _phases(
    rows: Sequence[LogRow], cost: CostModel, schedule: Schedule, clock: str
) -> Iterator[float]:
    """Yields for each fifth of a run what it took over what the cost model alone says."""
    column = "cpu_seconds" if clock == "cpu" else "seconds"
    levels = {level.level: level for level in cost.levels}
    took, told = np.zeros(_PHASES), np.zeros(_PHASES)
    for before, row in pairwise(rows):
        steps, count = row.iteration - before.iteration, row.gaussians or 0
        middle = (row.iteration + before.iteration) // 2
        phase = min(_PHASES - 1, int(_PHASES * schedule.share(middle)))
        took[phase] += getattr(row, column) - getattr(before, column)
        told[phase] += (steps * levels[schedule.level(middle)].ms(count)
                        + cost.report.ms(count)) / 1000
    yield from took / np.maximum(told, 1e-9)


@click.command()
@click.argument("workspaces", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--minutes", multiple=True, type=float)
@click.option("--quality", multiple=True)
@click.option("--max-size", type=int)
@click.option("--threads", default=1)
@click.option("--clock", type=click.Choice(list(CLOCKS)), default="cpu")
def main(
    workspaces: tuple[Path, ...], minutes: tuple[float, ...], quality: tuple[str, ...],
    max_size: int | None, threads: int, clock: str,
) -> None:
    """Prints the table."""
    registry.use_threads("numba", threads)
    registry.prepare("numba", lambda: None)
    ctx = StageContext(backend="numba", threads=threads)
    click.echo("| scene | asked | steps | Gaussians | calibration s | estimate s | took s "
               "| error | took over told, by fifths |\n|---|---|---:|---:|---:|---:|---:|---:|---|")
    parts = TrainConfig(
        early_stop=False, sh_degree=3, far="on", stereo="off", exposure="off",
        images="original", max_size=max_size)
    configs = [dataclasses.replace(parts, minutes=one) for one in minutes]
    configs += [dataclasses.replace(parts, quality=one) for one in quality]
    for config in configs:
        for workspace in workspaces:
            click.echo(row(workspace, config, ctx, clock))


if __name__ == "__main__":
    main()
