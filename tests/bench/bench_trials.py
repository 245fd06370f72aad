"""Holds what trials choose against full runs: `python tests/bench/bench_trials.py --help`.

WORKSPACES have their sfm done and are only read. For each, the trials of `recon train` choose the
optional parts of the model; then runs of full length differ from the chosen one in one part each.
Both are scored on the validation views, a fifth of the training views, each after its best gain;
exposure by the mean of the PSNR without and with it, as the .ply has no gains; how far views of the
same place differ stands behind its trial. `gain` is what a part is worth in the full run, `lost`
what the choice gives away: never more than .1 dB is the aim. With `--seeds` the full runs are
repeated, and the error holds what seeds differ by as well: one seed of a walk can be 1 dB off.

    python tests/bench/bench_trials.py living fox --iterations 3000 --iterations 10000
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

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

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.metrics import corrected_psnr, psnr
from recon_cli.evaluation.reference_views import render_view
from recon_cli.scene.scene import Scene
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import load_task, load_views
from recon_cli.train.parts.sparse_points import estimate_gains
from recon_cli.train.plan import Facts, cap, choose_parts, count_detail, first_config

VALIDATION = 0.2  # share of the training views: as many views as trials hold out by themselves
DEGREE = "sh-degree"
SWITCHED = {  # the other value of a part
    "background": ("off", "on"), "stereo": ("off", "on"), "exposure": ("off", "on"),
    "images": ("original", "denoised")}
ALL = (*SWITCHED, DEGREE)


class Capture:
    """A workspace whose cameras are known, and the runs made of it."""

    def __init__(
        self, workspace: Path, asked: TrainConfig, ctx: StageContext, seeds: int
    ) -> None:
        self.name, self.asked, self.ctx = workspace.name, asked, ctx
        self.scene: Scene = open_scene(workspace, VALIDATION)
        self.task: Task = load_task(self.scene, first_config(asked), ctx)
        self.needs = choose_parts(self.task, self.scene, ctx, harmonics=True)
        self._scores: dict[RunConfig, NDArray[np.float64]] = {}
        self.seeds = seeds

    def config(self, iterations: int) -> RunConfig:
        """Returns the options of a run with the chosen parts."""
        facts = Facts(count_detail(self.task.train), len(self.task.train),
                      len(self.scene.points), 10**9)
        return dataclasses.replace(
            self.needs.config, iterations=iterations, early_stop=False,
            max_gaussians=cap(self.asked, facts, iterations))

    def changed(self, config: RunConfig, part: str) -> RunConfig | None:
        """Returns the options with the other choice of a part; None where there is none."""
        if part == DEGREE:
            return dataclasses.replace(config, sh_degree=0 if config.sh_degree else 3)
        if part == "images" and not any(d.name == "images" for d in self.needs.decisions):
            return None  # nothing was denoised
        values = SWITCHED[part]
        value = values[1 - values.index(getattr(config, part))]
        return dataclasses.replace(config, **{part: value})  # type: ignore[arg-type]

    def scores(self, config: RunConfig) -> NDArray[np.float64]:
        """Returns the PSNR in dB of each validation view after a run, without and with gain."""
        if config not in self._scores:
            train = self.task.train
            if config.images == "denoised":
                train = load_views(self.scene.train, config, self.ctx)
            task = dataclasses.replace(
                self.task, train=train, validation=[], schedule=Schedule(config))
            state = train_model(task, self.scene)
            rows = []
            for view in self.task.validation:
                rgb = render_view(
                    state.splats, view.camera, config.sh_degree, task.backend).rgb.numpy()
                rows.append([score(rgb, view.image, view.mask) for score in (psnr, corrected_psnr)])
            self._scores[config] = np.array(rows)
        return self._scores[config]

    def row(self, part: str, iterations: int) -> tuple[str, ...] | None:
        """Returns the cells of one part at one length; None where there is no choice."""
        config = self.config(iterations)
        other = self.changed(config, part)
        if other is None:
            return None
        start = time.process_time()
        runs = [[self.scores(dataclasses.replace(one, seed=seed)) for seed in range(self.seeds)]
                for one in (config, other)]
        chosen, changed = np.array(runs)  # [S, V, 2] each
        seconds = time.process_time() - start
        on = (config.sh_degree > 0 if part == DEGREE
              else getattr(config, part) == SWITCHED[part][1])
        both = (chosen - changed) * (1 if on else -1)  # [S, V, 2]
        gains = both.mean(axis=2) if part == "exposure" else both[..., 1]
        mean, error = gains.mean(), standard_error(gains)
        as_is, corrected = both.mean(axis=(0, 1))
        trial = next((d for d in self.needs.decisions if d.name.startswith(
            "harmonics above degree 0" if part == DEGREE else part)), None)
        tried = ("no sign" if trial is None or trial.mean_db is None
                 else f"{trial.mean_db:+.2f} ± {trial.standard_error_db:.2f}")
        if part == "exposure":  # how far views of the same place differ
            local = estimate_gains(self.task.train, self.scene.points).local
            tried += f" ({local:.2f})"
        choice = str(config.sh_degree) if part == DEGREE else ("on" if on else "off")
        lost = max(0.0, -mean if on else mean)
        return (self.name, part, tried, choice, f"{iterations:,}", f"{chosen[..., 1].mean():.2f}",
                f"{as_is:+.2f}", f"{corrected:+.2f}", f"{mean:+.2f} ± {error:.2f}", f"{lost:.2f}",
                f"{seconds:.0f}")


def standard_error(gains: NDArray[np.float64]) -> float:
    """Returns the standard error of the mean of gains [S, V], over the views and the seeds."""
    by_view, by_seed = gains.mean(axis=0), gains.mean(axis=1)
    views = float(by_view.var(ddof=1)) / len(by_view)
    seeds = float(by_seed.var(ddof=1)) / len(by_seed) if len(by_seed) > 1 else 0.0
    return math.sqrt(views + seeds)


@click.command()
@workspaces_argument
@click.option("--iterations", "lengths", multiple=True, type=int, default=(3000, 10_000),
              show_default=True)
@click.option("--part", "parts", multiple=True, type=click.Choice(ALL), default=ALL,
              show_default=True)
@click.option("--max-size", default=400, show_default=True)
@click.option("--threads", default=1, show_default=True)
@click.option("--seeds", default=1, show_default=True, help="Of the full runs.")
def main(workspaces: tuple[Path, ...], lengths: tuple[int, ...], parts: tuple[str, ...],
         max_size: int, threads: int, seeds: int) -> None:
    """Print what each part is worth in the trial and in runs of full length, in dB."""
    ctx = numba_context(threads)
    print_head("capture", "part", "trial", "chosen", "steps", "PSNR", "gain as it is",
               "after gain", "counted", "lost", "CPU s")
    for workspace in workspaces:
        capture = Capture(workspace, TrainConfig(
            max_size=max_size, validation=VALIDATION), ctx, seeds)
        for iterations in lengths:
            for part in parts:
                line = capture.row(part, iterations)
                if line is not None:
                    print_row(*line)


if __name__ == "__main__":
    main()
