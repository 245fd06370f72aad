"""The verb `recon study`: what can be asked of it. Torch is imported only when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import bench_train
from recon_cli.commands.options import Call, pass_call
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.progress import TqdmProgress


@click.command("study")
@bench_train.scene_options
@click.option(
    "--seeds", type=click.IntRange(min=1), default=5, metavar="N",
    help="Runs of each arm, with seeds 0 to N - 1.  [default: 5]")
@click.option(
    "--iterations", type=click.IntRange(min=1), default=3000, metavar="N",
    help="Steps of every arm where steps are equal.  [default: 3000]")
@click.option(
    "--clock", type=click.Choice(["wall", "cpu"]), default="wall",
    help="Which seconds are made equal; cpu on a machine that others use too.  [default: wall]")
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("study"),
    help="Folder of finished runs, study.json, study.md and study.svg; what lies there is not run "
         "again.  [default: study]")
@bench_train.compute_options
@pass_call
def study(
    call: Call, more: tuple[Path, ...], scenes: tuple[Path, ...], seeds: int, iterations: int,
    max_size: int, max_gaussians: int, clock: str, out: Path,
) -> None:
    """Repeat the paper's experiment: 3DGS against ours.

    Trains 3DGS, 3DGS with the paper's prune, ours and ours pruned on every SCENE, at equal steps
    and at equal seconds, and scores them on held-out views, with intervals over the seeds.
    """
    from recon_cli.experiments.study_result import Request
    from recon_cli.experiments.study_run import run
    from recon_cli.experiments.train_result import base_config

    # nothing looks at validation views here, so all but the test views are trained on
    base = base_config(
        call.assigned, max_size=max_size, max_gaussians=max_gaussians, validation=0.0)
    click.echo(run(Request(
        (*scenes, *more), seeds, iterations, base, out, call.assigned,
        settings.build(ComputeConfig, call.settings), clock), TqdmProgress()))
