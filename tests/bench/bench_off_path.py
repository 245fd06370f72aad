"""Trains with changed options and scores what the path does not show.

`python tests/bench/bench_off_path.py WORKSPACE... --change NAME=VALUE,...`: WORKSPACES have their
sfm done and are only read. Of the training views by name, runs of five are taken away with the
points that fewer than two others see, a tenth of all or two runs: the stretches that are scored. A
workspace that has the name of a folder of ROOMS also has novel views of that room, whose true
cameras are moved by the similarity of the cameras of the video. Held-out views on the path are
scored beside them, those within a stretch left out. Options and recipe are changed as by
bench_recipe; each row is one change and seed, the first change none, and gains are paired by seed.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from bench_recipe import WARM, parsed, planned, take_away, trained
from numpy.typing import NDArray
from pose_errors import similarity
from workbench import (
    FOLDER,
    numba_context,
    open_scene,
    print_head,
    print_row,
    workspaces_argument,
)

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import load_reference_views
from recon_cli.evaluation.scores import MeanScore
from recon_cli.experiments.runner import score_as_ply
from recon_cli.io.images import fit_camera, read_image
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import load_task
from recon_cli.train.plan import Facts, count_detail, useful_cap

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "data" / "rooms"
RUN, SHARE, LEAST_RUNS = 5, 0.1, 2  # views of a stretch, share of all views, stretches
TRUE = Camera(600, 340, 300.0, 300.0, 300.0, 170.0, np.eye(4))  # of the rooms, centres at +.5
KINDS = "stretches", "novel", "path"


@dataclass(frozen=True)
class Capture:
    """A capture without its stretches, and the views to score by kind."""

    task: Task
    scene: Scene
    scored: dict[str, Sequence[TrainView]]


def choose_stretches(views: int) -> NDArray[np.bool_]:
    """Returns which of the views [V] in the order of the walk lie in stretches, evenly spread."""
    count = max(LEAST_RUNS, round(SHARE * views / RUN))
    away = np.zeros(views, bool)
    for middle in (np.arange(count) + 0.5) * views / count:
        first = round(middle - RUN / 2)
        away[first:first + RUN] = True
    return away


def novel_views(scene: Scene, room: Path, max_size: int) -> list[TrainView]:
    """Returns the novel views of a room with cameras in the world of a model of its video."""
    poses = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)
    true = np.stack([poses[int(Path(view.name).stem)][:3, 3] for view in scene.train])
    scale, motion = similarity(true, np.stack([view.camera.center for view in scene.train]))
    views = []
    tests = np.loadtxt(room / "test" / "traj.txt").reshape(-1, 4, 4)
    paths = sorted((room / "test" / "results").glob("frame*.jpg"))
    for pose, path in zip(tests, paths, strict=True):
        own = np.eye(4)
        own[:3, :3] = motion[:3, :3] @ pose[:3, :3]
        own[:3, 3] = scale * motion[:3, :3] @ pose[:3, 3] + motion[:3, 3]
        camera = fit_camera(dataclasses.replace(TRUE, viewmat=np.linalg.inv(own)), max_size)
        views.append(TrainView(camera, read_image(path, camera.width, camera.height)))
    return views


def open_capture(workspace: Path, rooms: Path, config: RunConfig, ctx: StageContext) -> Capture:
    """Returns a capture; the cap of the count is that of the plan."""
    whole = open_scene(workspace, 0.0)
    away = choose_stretches(len(whole.train))
    scene, sparse = take_away(whole, away, away)
    task = load_task(scene, config, ctx)
    evidence = dataclasses.replace(sparse, views=task.train)
    task = dataclasses.replace(task, evidence=evidence, validation=[])
    facts = Facts(count_detail(task.train), len(task.train), len(scene.points), 0)
    task = planned(task, {"max_gaussians": useful_cap(facts, config.iterations)}, 0)
    names = sorted(view.name for view in whole.train)
    held_out = [view for view in scene.test
                if not away[min(np.searchsorted(names, view.name), len(names) - 1)]]
    room = rooms / workspace.name
    return Capture(task, scene, {
        "stretches": load_reference_views(scene.validation, config.max_size, ctx),
        "novel": novel_views(whole, room, config.max_size) if room.is_dir() else [],
        "path": load_reference_views(held_out, config.max_size, ctx)})


@dataclass(frozen=True)
class Run:
    """The scores of a run by kind of views, and what it took."""

    scores: dict[str, MeanScore]
    gaussians: int
    seconds: float

    def cells(self, before: Run | None) -> list[str]:
        """Returns the cells of a table, with the gain over another run of the same seed."""
        cells = []
        for kind in KINDS:
            score = self.scores.get(kind)
            if score is None:
                cells.append("")
                continue
            gain = 0.0 if before is None else score.psnr_db - before.scores[kind].psnr_db
            cells.append(f"{score.psnr_db:.2f}{f' ({gain:+.2f})' if before else ''}"
                         f" / {score.ssim:.4f}")
        return [*cells, f"{self.gaussians:,}", f"{self.seconds:.1f}"]


def measure(capture: Capture, changes: dict[str, Any], seed: int, ctx: StageContext) -> Run:
    """Returns the scores of one run."""
    task = planned(capture.task, changes, seed)
    begin = time.process_time()
    splats = trained(task, capture.scene).splats.map(lambda tensor: tensor.detach())
    seconds = time.process_time() - begin
    degree = task.schedule.config.sh_degree
    return Run({kind: score_as_ply(splats, views, degree, ctx)[0]
                for kind, views in capture.scored.items() if views}, len(splats), seconds)


@click.command()
@workspaces_argument
@click.option("--rooms", type=FOLDER, default=ROOMS, help="Folder of rooms with novel views.")
@click.option("--set", "common", multiple=True, help="NAME=VALUE,...: options of all rows.")
@click.option("--change", "changed", multiple=True, help="NAME=VALUE,...: of one row.")
@click.option("--seeds", default=1, show_default=True)
@click.option("--iterations", default=900, show_default=True)
@click.option("--max-size", default=300, show_default=True)
@click.option("--threads", default=1, show_default=True)
def main(workspaces: tuple[Path, ...], rooms: Path, common: tuple[str, ...],
         changed: tuple[str, ...], seeds: int, iterations: int, max_size: int,
         threads: int) -> None:
    """Print PSNR and SSIM of stretches, of novel views and of views on the path."""
    ctx = numba_context(threads)
    config = RunConfig(
        iterations=iterations, max_size=max_size, validation=0.0, max_gaussians=1000, sh_degree=2,
        images="original", background="on", stereo="on", exposure="off", early_stop=False)
    shared = {name: value for text in common for name, value in parsed(text).items()}
    print_head("scene", "change", "seed", *KINDS, "Gaussians", "CPU s")
    gains: dict[tuple[str, str], list[float]] = {}
    for workspace in workspaces:
        capture = open_capture(workspace, rooms, config, ctx)
        trained(planned(capture.task, {"iterations": WARM}, 0), capture.scene)
        for seed in range(seeds):
            before = None
            for text in ("", *changed):
                run = measure(capture, {**shared, **parsed(text)}, seed, ctx)
                print_row(workspace.name, text or "nothing", str(seed), *run.cells(before))
                before = before or run
                for kind, score in run.scores.items():
                    gains.setdefault((text, kind), []).append(
                        score.psnr_db - before.scores[kind].psnr_db)
    for text in changed:
        print_row("mean gain", text, "", *(
            f"{statistics.mean(gains[text, kind]):+.2f}" if (text, kind) in gains else ""
            for kind in KINDS), "", "")


if __name__ == "__main__":
    main()
