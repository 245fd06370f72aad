"""Shared by the scripts of this folder: arguments, workspaces, tables, and recon as a process."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.io.training_scene import load_scene
from recon_cli.render.registry import use_threads
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.sfm.job import CameraGroup, MappingJob
from recon_cli.splats.ply import read_ply
from recon_cli.train.fit.initialize import first_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import read_config
from recon_cli.train.plan import first_count
from recon_cli.workspace import records
from recon_cli.workspace.layout import Workspace

FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
workspace_argument = click.argument("workspace", type=FOLDER)
workspaces_argument = click.argument("workspaces", nargs=-1, required=True, type=FOLDER)
STAGES = ("ingest", "denoise", "sfm", "place", "train")


def numba_context(threads: int = 1) -> StageContext:
    """Returns a context of the numba backend, which may use that many threads."""
    use_threads("numba", threads)
    return StageContext(backend="numba", threads=threads)


def stage_folders(workspace: Path) -> dict[str, Path]:
    """Returns the folders of a workspace's stages by name."""
    return {name: Workspace(workspace).folder(name) for name in STAGES}


def open_scene(workspace: Path, validation: float) -> Scene:
    """Returns the views and points of a workspace; `validation` is a share of training views."""
    return load_scene(stage_folders(workspace), validation=validation)


def open_trained(workspace: Path) -> tuple[RunConfig, Scene, Splats]:
    """Returns the options, the scene and the Gaussians of a training."""
    config = read_config(workspace / "train")
    return (config, open_scene(workspace, config.validation),
            read_ply(workspace / "train" / "splats.ply"))


def train_model(task: Task, scene: Scene) -> TrainState:
    """Returns the state at the end of a run."""
    config = task.schedule.config
    state = first_state(
        task, scene.points, scene.colors, most=first_count(config, len(scene.points)))
    fit(state, task, config.iterations)
    return state


def print_head(*headings: str) -> None:
    """Prints the head of a Markdown table."""
    print_row(*headings)
    click.echo(f"|---|{'---:|' * (len(headings) - 1)}")


def print_row(*cells: str) -> None:
    """Prints a row of a Markdown table at once."""
    click.echo(f"| {' | '.join(cells)} |")
    sys.stdout.flush()


@dataclass(frozen=True)
class Finished:
    """A command that has ended."""

    code: int
    error: str  # its first error line, if any
    cpu_seconds: float
    seconds: float


def run_recon(workspace: Path, verb: str, *arguments: str) -> Finished:
    """Runs a verb as a user does, and shows what it prints to stderr."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "recon_cli", verb, *arguments, "-w", str(workspace)],
        stderr=subprocess.PIPE, text=True)
    click.echo(done.stderr, err=True, nl=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    return Finished(
        done.returncode, errors[0] if errors else "",
        after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime,
        time.monotonic() - start)


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def mapping_job(ingest: Path, out: Path, **changes: Any) -> MappingJob:
    """Returns a job for sfm on the frames in a folder of ingest, with some fields changed."""
    frames = records.read_frame_list(ingest)
    groups = tuple(
        CameraGroup(tuple(frame.name for frame in frames.frames if frame.group == index),
                    group.width, group.height, group.focal_px, group.lens)
        for index, group in enumerate(frames.groups))
    fields = {
        "masks": None, "poses": None, "pose_use": "ignore", "given_points": False, "pairs": "auto",
        "max_features": 3000, "min_registered": 0.5, "accept_weak": False, "partial": False,
        "max_minutes": 60.0, "seed": 0, "threads": 1,
        "sharpness": {}, "times": {}, **changes}
    return MappingJob(frames=ingest / records.FOLDER, out=out,
                      groups=groups, **fields)
