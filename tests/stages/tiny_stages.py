"""Finished stages of the tiny scene, for tests of what follows them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from tiny_scene import make_inputs

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import PruneConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.evaluation.metrics import psnr
from recon_cli.io.images import read_image
from recon_cli.stages import export, prune, train

CONFIG = RunConfig(
    iterations=160, densify_every=10, densify_gradient=1e-5, max_gaussians=120, sh_rate=0.05,
    checkpoint_every=7)
PRUNE = PruneConfig(ratio=0.5, at="mid")
LEARNT = RunConfig(iterations=120, max_gaussians=120, sh_rate=0.01)  # harmonics that show
CONTEXT = StageContext(backend="numba")


def trained(folder, config=CONFIG):
    """ingest, sfm, and a finished train."""
    given = make_inputs(folder)
    (folder / "train").mkdir()
    train.run(config, given, folder / "train", CONTEXT)
    return StageInputs({**given.folders, "train": folder / "train"})


def pruned(folder):
    """ingest, sfm, and a finished train and prune."""
    inputs = trained(folder)
    (folder / "prune").mkdir()
    prune.run(PRUNE, inputs, folder / "prune", CONTEXT)
    return StageInputs({**inputs.folders, "prune": folder / "prune"})


def run(stage, config, inputs, out, ctx=CONTEXT):
    out.mkdir(exist_ok=True)
    return stage.run(config, inputs, out, ctx)


def without(inputs, *names):
    return StageInputs({k: v for k, v in inputs.folders.items() if k not in names})


def holding_out(inputs, tmp_path, *, held_out):
    """The same inputs with every view held out, or none."""
    folder = tmp_path / "ingest"
    shutil.copytree(inputs.folders["ingest"], folder)
    frames = json.loads((folder / "frames.json").read_text())
    for frame in frames["frames"]:
        frame["held_out"] = held_out
    (folder / "frames.json").write_text(json.dumps(frames))
    return StageInputs({**inputs.folders, "ingest": folder})


def mean_colour_psnr(inputs):
    """PSNR of painting a view in its own mean colour: what knowing nothing of its shape gives."""
    image = read_image(inputs.folders["place"] / "undistorted" / "images" / "000006.png", 48, 36)
    mean = np.broadcast_to(image.mean((0, 1)) / 255, image.shape).astype(np.float32)
    return psnr(mean, image)


def run_export(
    config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext = CONTEXT
) -> SimpleNamespace:
    """Exports the .ply and its other formats to one folder; their records are `files`."""
    ctx = replace(ctx, shared={})
    summary = export.run(config, inputs, out, ctx)
    folders = {**inputs.folders, "export": out}
    return SimpleNamespace(**vars(summary), files={
        name: export.run(config, replace(inputs, folders=folders, part=name), out, ctx)
        for name in config.parts})
