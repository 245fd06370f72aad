"""How well the time of a training is told before it starts, on posed workspaces.

    python tests/bench/bench_estimate.py WORKSPACE... [--minutes 0.25 --minutes 1] [--quality draft]
        [--threads 1] [--clock cpu]

Each workspace needs a finished sfm. `--clock cpu` plans and measures by the CPU time of this
process: with one thread that is what a machine with nothing else to do takes, whatever others run
on this one. `--clock wall` is what a user sees.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import click

from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.evaluation.reference_views import load_scene
from recon_cli.render import registry
from recon_cli.stages import train
from recon_cli.train import plan
from recon_cli.train.cost import calibrate
from recon_cli.train.runner import Segment, run_fit
from recon_cli.train.train_data import gaussians_that_fit, load_task

CLOCKS = {"cpu": time.process_time, "wall": time.perf_counter}


def row(workspace: Path, config: TrainConfig, ctx: StageContext, clock: str) -> str:
    """Plans and runs one training and returns its line of the table."""
    now = CLOCKS[clock]
    inputs = StageInputs({name: workspace / name for name in ("ingest", "sfm")})
    scene = load_scene(inputs, validation=config.validation)
    first = plan.first_config(config)
    task = load_task(scene, first, ctx)
    facts = plan.Facts(plan.count_detail(task.train), len(task.train), len(scene.points),
                       gaussians_that_fit(scene, first, ctx))
    seconds = (plan.CALIBRATION_SECONDS if config.minutes is None
               else plan.CALIBRATION_SHARE * 60 * config.minutes)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        cost = calibrate(
            train._with(task, plan.probe_config(config, facts)), scene.points, scene.colors,
            scratch=out / "calibration.safetensors", clock=now, seconds=seconds)
        made = plan.make_plan(config, facts, cost)
        task = train._with(task, made.config(config))
        state = train._state(task, scene, out / "none")
        begin = now()
        run_fit(state, task, made.iterations, Segment(out, "train", made.iterations), ctx)
        took = now() - begin
    asked = config.quality if config.minutes is None else f"{config.minutes:g} min"
    return (f"| {workspace.name} | {asked} | {made.iterations} | {len(state.splats)} | "
            f"{cost.seconds:.2f} | {made.seconds:.1f} | {took:.1f} | "
            f"{100 * (made.seconds / took - 1):+.0f}% |")


@click.command()
@click.argument("workspaces", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--minutes", multiple=True, type=float)
@click.option("--quality", multiple=True)
@click.option("--threads", default=1)
@click.option("--clock", type=click.Choice(list(CLOCKS)), default="cpu")
def main(
    workspaces: tuple[Path, ...], minutes: tuple[float, ...], quality: tuple[str, ...],
    threads: int, clock: str,
) -> None:
    """Prints the table."""
    registry.use_threads("numba", threads)
    registry.prepare("numba", lambda: None)
    ctx = StageContext(backend="numba", threads=threads)
    click.echo("| scene | asked | steps | Gaussians | calibration s | estimate s | took s "
               "| error |\n|---|---|---:|---:|---:|---:|---:|---:|")
    configs = [TrainConfig(minutes=one, early_stop=False) for one in minutes]
    configs += [TrainConfig(quality=one, early_stop=False) for one in quality]
    for config in configs:
        for workspace in workspaces:
            click.echo(row(workspace, config, ctx, clock))


if __name__ == "__main__":
    main()
