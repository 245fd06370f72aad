"""Finished workspaces of a tiny scene: real stages run once, then copied into a workspace each."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import summaries as records
from tiny_scene import make_inputs
from tiny_stages import CONTEXT, PRUNE

from recon_cli.cli import main
from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import EvaluateConfig, RunConfig, TrainConfig
from recon_cli.context import StageInputs
from recon_cli.io.images import read_image, write_png
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.stages import STAGES, evaluate, export, prune, train
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import Manifest

TABLE = tuple(replace(row, module="report_workspace", renders=False) for row in STAGES)
RUN = {"iterations": 60, "max_gaussians": 120, "sh_rate": 0.05, "densify_every": 10,
       "densify_gradient": 1e-5, "validation": 0.15}
CONFIGS = {"train": TrainConfig(**RUN), "prune": PRUNE,
           "export": ExportConfig(format="spz", max_loss=3.0)}
HELD_OUT = ("000000.png", "000004.png", "000008.png")
INGEST = replace(records.INGEST, held_out=3, width=48, height=36)
PLACE = replace(
    records.PLACE, registered=12, lines=("12 of 12 images have a camera.", "Weakest link: 88%."),
    world=replace(records.WORLD, sentences=("z is up.",), evidence=replace(
        records.EVIDENCE, up_found=True, metres=True)))

prepared: dict[str, Path] = {}  # the folder of all stages
summaries: dict[str, Any] = {}


def run(config, inputs, out, ctx):  # noqa: ARG001 - the signature of a stage
    source = prepared["folder"] / out.name
    if source.is_dir():
        shutil.copytree(source, out, dirs_exist_ok=True)
    return summaries[out.name]


def make_workspace(folder: Path) -> Path:
    """Returns a workspace in which every stage is fresh, of 12 views, 3 of them held out."""
    made = folder / "made"
    inputs = make_inputs(made)
    (made / "ingest" / "frames").mkdir()
    for path in (made / "place" / "undistorted" / "images").iterdir():
        shutil.copy(path, made / "ingest" / "frames" / path.name)
    for name, stage, config in (
            ("train", train, RunConfig(**RUN)), ("prune", prune, PRUNE),
            ("evaluate", evaluate, EvaluateConfig()), ("export", export, CONFIGS["export"])):
        (made / name).mkdir()
        summaries[name] = stage.run(config, inputs, made / name, CONTEXT)
        inputs = StageInputs({**inputs.folders, name: made / name})
    summaries.update({"ingest": INGEST, "denoise": records.DENOISE, "sfm": PLACE, "place": PLACE})
    prepared["folder"] = made
    (folder / "room.mp4").write_text("a video")
    bring(folder / "ws", *(row.name for row in TABLE), video=folder / "room.mp4")
    return folder / "ws"


def bring(workspace: Path, *names: str, video: Path | None = None) -> None:
    """Copies stages into a workspace, as if they had been run."""
    plan.run(Job(Workspace(workspace), table=TABLE), "run", [
        Target(row.name, CONFIGS.get(row.name, row.config()),
               (video,) if video and row.name == "ingest" else ())
        for row in TABLE if row.name in names])


def report(workspace: Path, *words: object) -> int:
    return main(["report", "-w", str(workspace), *map(str, words)])


def page_of(workspace: Path) -> str:
    """Writes the page of a workspace and returns it."""
    assert report(workspace) == 0
    return (workspace / "report.html").read_text(encoding="utf-8")


def section(page: str, name: str) -> str:
    """Returns one section of a page."""
    match = re.search(rf'<section [^>]*id="{name}".*?</section>', page, re.DOTALL)
    assert match, f"no section {name}"
    return match.group()


def change(path: Path, edit) -> None:
    """Rewrites a JSON file as somebody's hand would."""
    value = json.loads(path.read_text())
    edit(value)
    path.write_text(json.dumps(value))


def give_title(workspace: Path, title: str) -> None:
    """Makes the export one that was given a title."""
    manifest = Manifest.read(workspace / "export", "manifest.spz.json")
    key = replace(manifest.key, stage="export.html", config={
        **manifest.key.config, "title": title})
    replace(manifest, key=key).write(workspace / "export")


def paint(workspace: Path, *, truth: int, render: int) -> None:
    """Makes every held-out picture of one gray and every render of another."""
    for path in (workspace / "evaluate").rglob("*.png"):
        value = truth if path.parent.name == "truth" else render
        write_png(path, np.full_like(read_image(path, 48, 36), value))
