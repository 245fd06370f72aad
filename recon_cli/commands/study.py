"""`recon study`: the options of the paper's experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from recon_cli.commands.bench_train import SceneOptions, compute_options, scene_options
from recon_cli.commands.options import Call, pass_call
from recon_cli.lazy import load
from recon_cli.progress import TqdmProgress


@click.command("study")
@scene_options
@click.option(
    "--seeds", type=click.IntRange(min=1), default=5, metavar="N",
    help="Runs of each variant, with seeds 0 to N - 1.  [default: 5]")
@click.option(
    "--iterations", type=click.IntRange(min=1), default=3000, metavar="N",
    help="Steps of every variant where steps are equal.  [default: 3000]")
@click.option(
    "--clock", type=click.Choice(["wall", "cpu"]), default="wall",
    help="Which seconds are made equal; cpu on a machine that others use too.  [default: wall]")
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("study"),
    help="Folder of finished runs, study.json, study.md and study.svg; runs found there are not "
         "made again.  [default: study]")
@compute_options
@pass_call
def study(call: Call, /, scenes: SceneOptions, **typed: Any) -> None:
    """Repeat the paper's experiment: 3DGS against ours.

    Trains 3DGS, 3DGS with the paper's prune, ours and ours pruned on every SCENE, at equal steps
    and at equal seconds, and scores them on held-out views, with intervals over the seeds.
    """
    request = load("recon_cli.experiments.study.StudyRequest")
    run = load("recon_cli.experiments.study.run")
    # nothing looks at validation views here, so all but the test views are trained on
    shared = scenes.fields(call, validation=0.0)
    click.echo(run(request(**shared, **typed), TqdmProgress()))
