"""What fitting the light of images is worth: gains and vignettes, alone or together.

    python tests/bench/bench_light.py WORKSPACE ... --parts "" --parts vignette --parts auto

Each row is a run with the parts on that it names; without any it is the recipe as it is, and `auto`
are those that the trials of `recon train` choose at 600 pixels. Held-out views are scored as they
are, after the best gain of each, and after the mean gain of the training views before and after in
time, which a run with exposures knows without the held-out view. A fitted vignette shades the
renders, as `recon eval` does. The last rows are means over the captures, with the gain over the
first row.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path

import click
import numpy as np
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
from recon_cli.evaluation.metrics import corrected_psnr, psnr
from recon_cli.evaluation.reference_views import load_reference_views, render_view
from recon_cli.io.views import ReferenceView
from recon_cli.scene.scene import Scene
from recon_cli.train.parts.part import TrialScene
from recon_cli.train.parts.sparse_points import estimate_gains
from recon_cli.train.parts.trials import examine
from recon_cli.train.parts.vignette import find_vignettes
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task
from recon_cli.train.train_data import load_task

PARTS = ("exposure", "vignette")
TRIAL_SIZE = 600  # pixels; of `recon train` by default


def score(
    state: TrainState, task: Task, scene: Scene, views: list[ReferenceView]
) -> tuple[float, float, float | None]:
    """Returns the mean PSNR as it is, after the best gain, and after that of the neighbours."""
    photometry = state.photometry
    names, rows = [view.name for view in scene.train], []
    for view in views:
        rgb = render_view(
            state.splats, view.camera, task.schedule.config.sh_degree, task.backend).rgb.numpy()
        if photometry is not None and photometry.falloffs is not None:
            rgb = photometry.falloffs.shade(rgb, view.camera)
        row = [psnr(rgb, view.image, view.mask), corrected_psnr(rgb, view.image, view.mask)]
        if photometry is not None and photometry.exposure is not None:
            place = sum(name < view.name for name in names)
            near = photometry.exposure.log_gains[max(0, place - 1):place + 1].mean(axis=0)
            row.append(psnr(rgb * np.exp(near).astype(np.float32), view.image, view.mask))
        rows.append(row)
    means = np.mean(rows, axis=0)
    return float(means[0]), float(means[1]), float(means[2]) if len(means) > 2 else None


def choose_parts(scene: Scene, config: RunConfig, ctx: StageContext) -> str:
    """Returns the parts that trials switch on."""
    options = dataclasses.replace(config, max_size=TRIAL_SIZE, **dict.fromkeys(PARTS, "auto"))
    task = load_task(scene, options, ctx)
    chosen = examine(TrialScene(task, scene.points, scene.colors, None)).config
    return ",".join(part for part in PARTS if getattr(chosen, part) == "on")


@click.command()
@workspaces_argument
@click.option("--parts", "chosen", multiple=True, default=("", "exposure", "vignette"),
              show_default=True, help="PART,... that are on in a row, or auto.")
@click.option("--seeds", default=1, show_default=True)
@click.option("--iterations", default=900, show_default=True)
@click.option("--max-size", default=320, show_default=True)
@click.option("--max-gaussians", default=20_000, show_default=True)
def main(workspaces: tuple[Path, ...], chosen: tuple[str, ...], seeds: int, iterations: int,
         max_size: int, max_gaussians: int) -> None:
    """Print the held-out PSNR with the parts that take light out of the scene."""
    ctx = numba_context(1)
    print_head("capture", "drift, place, corner", "parts", "as is",
               "after best gain", "after neighbours' gain", "CPU s")
    scores: dict[str, list[tuple[float, ...]]] = {words: [] for words in chosen}
    for workspace in workspaces:
        scene = open_scene(workspace, 0.0)
        base = RunConfig(
            iterations=iterations, max_size=max_size, max_gaussians=max_gaussians, sh_degree=1,
            images="original", background="on", stereo="off", moving="off", early_stop=False)
        task = load_task(scene, base, ctx)
        drift = estimate_gains(task.train, scene.points)
        corners = find_vignettes(task.train, scene.points).corner_loss
        signs = f"{drift.spread:.3f}, {drift.local:.2f}, {corners:.3f}"
        views = load_reference_views(scene.test, max_size, ctx)
        known: dict[str, tuple[float | None, ...]] = {}  # a choice of trials may be a row as well
        for words in chosen:
            start = time.process_time()
            on = choose_parts(scene, base, ctx) if words == "auto" else words
            if on not in known:
                found = []
                for seed in range(seeds):
                    config = dataclasses.replace(base, seed=seed, **{
                        part: "on" if part in on.split(",") else "off" for part in PARTS})
                    run = dataclasses.replace(task, schedule=Schedule(config))
                    found.append(score(train_model(run, scene), run, scene, views))
                known[on] = tuple(None if None in column else statistics.mean(column)
                                  for column in zip(*found, strict=True))
            scores[words].append(known[on][:2])
            name = f"auto: {on or 'none'}" if words == "auto" else words or "none"
            print_row(workspace.name, signs, name,
                      *("" if cell is None else f"{cell:.2f}" for cell in known[on]),
                      f"{(time.process_time() - start) / seeds:.0f}")
    first = np.mean(scores[chosen[0]], axis=0)
    for words in chosen:
        means = np.mean(scores[words], axis=0)
        print_row(f"mean of {len(workspaces)}", "", words or "none",
                  *(f"{mean:.2f} ({mean - before:+.2f})"
                    for mean, before in zip(means, first, strict=True)), "", "")


if __name__ == "__main__":
    main()
