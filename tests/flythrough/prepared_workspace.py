"""Finished workspaces without a training: each stage copies what was prepared for it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import summaries
import torch
from tiny_scene import make_inputs

from recon_cli.config.stages import ComputeConfig, RunConfig
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import write_ply
from recon_cli.stages import STAGES
from recon_cli.train.fit.train_data import write_config
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.layout import Workspace

TABLE = tuple(replace(row, module="prepared_workspace", renders=False) for row in STAGES)
prepared: dict[str, Path] = {}  # the folder of all stages
evidence: dict[str, Any] = {}  # what sfm says of the world


def run(config, inputs, out, ctx):  # noqa: ARG001 - the signature of a stage
    source = prepared["folder"] / out.name
    if source.is_dir():
        shutil.copytree(source, out, dirs_exist_ok=True)
    if out.name == "place":
        world = replace(summaries.WORLD, evidence=replace(summaries.EVIDENCE, **evidence))
        write_json(out / "world.json", world.to_json())
        return replace(summaries.PLACE, world=world)
    return summaries.BY_STAGE[out.name]


def make_workspace(
    folder: Path, splats: Splats, *, pruned: Splats | None = None, metres: bool = False,
    up_found: bool = True, shapes=None,
) -> Path:
    """Returns a workspace of tiny_scene's 12 views whose trained model is `splats`."""
    make_inputs(folder / "made", *([shapes] if shapes else []))
    for name, model in (("train", splats), ("prune", pruned)):
        if model is not None:
            (folder / "made" / name).mkdir()
            write_ply(folder / "made" / name / "splats.ply", model)
            write_config(folder / "made" / name, RunConfig(sh_degree=model.sh_degree))
    (folder / "room.mp4").write_text("a video")
    prepared["folder"] = folder / "made"
    evidence.update(up_found=up_found, metres=metres)
    names = ["ingest", "denoise", "sfm", "place", "train",
             *(["prune"] if pruned is not None else [])]
    job = Job(Workspace(folder / "ws"), compute=ComputeConfig(), table=TABLE)
    plan.run(job, "run", [
        Target(row.name, row.config(), (folder / "room.mp4",) if row.name == "ingest" else ())
        for row in TABLE if row.name in names])
    return folder / "ws"


def wall(depth: float, *, spacing: float = 0.08, half: float = 5.0) -> Splats:
    """Returns flat, nearly opaque Gaussians in the plane z = depth, coloured by their place."""
    steps = torch.arange(-half, half, spacing)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    n = x.numel()
    means = torch.stack([x.ravel(), y.ravel(), torch.full((n,), float(depth))], dim=-1)
    log_scales = torch.log(torch.tensor([spacing, spacing, 1e-4])).repeat(n, 1)
    return Splats(
        means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), log_scales, torch.full((n,), 6.0),
        torch.sin(means), torch.zeros(0, 0, 3))
