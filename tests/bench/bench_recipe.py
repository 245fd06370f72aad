"""Trains with a changed recipe and scores: `python tests/bench/bench_recipe.py --help`.

WORKSPACES have their sfm done and are only read. Optional parts are as `--set` says, far content
on where it is not said; no trial is made, no step is skipped, all views that are not held out are
trained on. To choose between changes, score validation views instead (`--validation .15`): a choice
made by held-out views would flatter it. `--stretches` scores how the model looks off the path: of
each 30 views by name nine in a row are taken away, with the points that fewer than two others see,
and the middle three of them scored. Each row is one change, the first none:

    python tests/bench/bench_recipe.py living --set sh_degree=0 --change means_rate=2 \
        --change final_from=.6,final_rate=.03 --change max_gaussians=40000
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import numpy as np
from numpy.typing import NDArray
from workbench import (
    numba_context,
    open_scene,
    print_head,
    print_row,
    train_model,
    workspaces_argument,
)

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import load_reference_views
from recon_cli.experiments.runner import score_as_ply
from recon_cli.io.colmap import read_visibility
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.scene import Scene
from recon_cli.train.fit.schedule import RECIPES, Recipe, Schedule
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.task import Evidence, Task
from recon_cli.train.fit.train_data import load_task
from recon_cli.train.plan import Facts, count_detail, useful_cap

WARM = 20  # steps that load what is compiled
SHOWN = 20  # training views that are scored, at most
EVERY, GAP, MIDDLE = 30, 9, 3  # views from one stretch to the next, in a stretch, scored of it
SEES = 2  # views that a point needs, as in any mapping
FIELDS = {field.name for field in dataclasses.fields(Recipe)}


def parsed(text: str) -> dict[str, Any]:
    """Returns {name: value} of `name=value,...`; values are numbers where they can be."""
    def value(word: str) -> Any:
        for kind in (int, float):
            try:
                return kind(word)
            except ValueError:
                pass
        return word

    return {name: value(word) for name, word in (
        pair.split("=", 1) for pair in text.split(",") if pair)}


def planned(task: Task, changes: dict[str, Any], seed: int) -> Task:
    """Returns the task with a changed recipe where it has the name, and changed options.

    `half=S` stands for levels=((S, 2),), images at half their size until that share.
    """
    changes = dict(changes)
    if "half" in changes:
        changes["levels"] = ((changes.pop("half"), 2),)
    config = dataclasses.replace(task.schedule.config, seed=seed, **{
        name: value for name, value in changes.items() if name not in FIELDS})
    recipe = dataclasses.replace(RECIPES[config.densify], **{
        name: value for name, value in changes.items() if name in FIELDS})
    return dataclasses.replace(task, schedule=Schedule(config, recipe))


def trained(task: Task, scene: Scene) -> TrainState:
    """Returns the state at the end of a run."""
    schedule = task.schedule  # the optimizer looks for its recipe in RECIPES
    with patch.dict(RECIPES, {schedule.config.densify: schedule.recipe}):
        return train_model(task, scene)


def row(name: str, task: Task, scene: Scene, changes: dict[str, Any], seeds: range,
        ctx: StageContext) -> tuple[str, ...]:
    """Returns the means over seeds as cells of a table."""
    size = task.schedule.config.max_size
    scored = load_reference_views(scene.validation or scene.test, size, ctx)
    shown = task.train[::max(1, -(-len(task.train) // SHOWN))]
    found = []
    for seed in seeds:
        run = planned(task, changes, seed)
        begin = time.process_time()
        state = trained(run, scene)
        seconds = time.process_time() - begin
        splats = state.splats.map(lambda tensor: tensor.detach())
        test, train = (score_as_ply(splats, views, run.schedule.config.sh_degree, ctx)[0]
                       for views in (scored, shown))
        found.append((test.psnr_db, test.ssim, train.psnr_db, seconds, len(splats)))
    middle = [statistics.mean(column) for column in zip(*found, strict=True)]
    spread = f"{statistics.stdev(f[0] for f in found):.2f}" if len(found) > 1 else ""
    words = ",".join(f"{key}={value}" for key, value in changes.items()) or "nothing"
    return (name, words, f"{middle[0]:.2f} / {middle[1]:.4f}", spread, f"{middle[2]:.2f}",
            f"{middle[4]:,.0f}", f"{middle[3]:.0f}")


def without_stretches(scene: Scene) -> tuple[Scene, Evidence]:
    """Returns the scene without stretches of its training views, whose middle is validated."""
    place = np.arange(len(scene.train)) % EVERY - (EVERY // 2 - 1)
    return take_away(scene, np.abs(place) <= GAP // 2, np.abs(place) <= MIDDLE // 2)


def take_away(
    scene: Scene, away: NDArray[np.bool_], scored: NDArray[np.bool_]
) -> tuple[Scene, Evidence]:
    """Returns the scene without some of its training views by name, some of which are validated.

    The rows of a sparse model change with the points that go.
    """
    views = sorted(scene.train, key=lambda view: view.name)
    train = tuple(view for view, gone in zip(views, away, strict=True) if not gone)
    sees = observe_points(scene.points, [view.camera for view in train])
    kept = np.bincount(sees.point, minlength=len(scene.points)) >= SEES
    tracks = {} if scene.sparse is None else read_visibility(scene.sparse)
    rows = [tracks.get(view.name, np.empty(0, np.int64)) for view in train]
    seen = [np.cumsum(kept)[mine[kept[mine]]] - 1 for mine in rows]
    rest = dataclasses.replace(
        scene, train=train, points=scene.points[kept], colors=scene.colors[kept],
        validation=tuple(view for view, own in zip(views, scored, strict=True) if own))
    return rest, Evidence([], rest.points, rest.extent, lambda: seen)


@click.command()
@workspaces_argument
@click.option("--set", "common", multiple=True, help="NAME=VALUE,...: options of all rows.")
@click.option("--change", "changed", multiple=True, help="NAME=VALUE,...: of one row.")
@click.option("--seeds", default="1", show_default=True, help="N for 0 to N - 1, or A-B.")
@click.option("--iterations", default=3000, show_default=True)
@click.option("--max-size", default=600, show_default=True)
@click.option("--max-gaussians", default=100_000, show_default=True, help="0: by the plan.")
@click.option("--threads", default=1, show_default=True)
@click.option("--validation", default=0.0, help="Share of the training views to score instead.")
@click.option("--stretches", is_flag=True, help="Score views in the middle of what is taken away.")
def main(workspaces: tuple[Path, ...], common: tuple[str, ...], changed: tuple[str, ...],
         seeds: str, iterations: int, max_size: int, max_gaussians: int, threads: int,
         validation: float, stretches: bool) -> None:
    """Print held-out and training PSNR of each change."""
    ctx = numba_context(threads)
    first, _, last = seeds.partition("-")
    chosen = range(int(first), int(last) + 1) if last else range(int(first))
    base = RunConfig(
        iterations=iterations, max_size=max_size, validation=validation,
        max_gaussians=max_gaussians or 1000,  # until the plan's is known
        images="original", background="on", exposure="off",
        early_stop=False)
    shared = {name: value for text in common for name, value in parsed(text).items()}
    print_head(
        "scene", "change", "PSNR / SSIM", "deviation", "training views", "Gaussians", "CPU s")
    for workspace in workspaces:
        scene = open_scene(workspace, base.validation)
        if stretches:
            scene, sparse = without_stretches(scene)
        task = load_task(scene, base, ctx)
        if stretches:
            task = dataclasses.replace(
                task, evidence=dataclasses.replace(sparse, views=task.train))
        if max_gaussians == 0:
            facts = Facts(count_detail(task.train), len(task.train), len(scene.points), 0)
            task = planned(task, {"max_gaussians": useful_cap(facts, iterations)}, 0)
        trained(planned(task, {"iterations": WARM}, 0), scene)
        for changes in ({}, *map(parsed, changed)):
            print_row(*row(workspace.name, task, scene, {**shared, **changes}, chosen, ctx))


if __name__ == "__main__":
    main()
