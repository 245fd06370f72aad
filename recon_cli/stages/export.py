"""export: a .ply that other viewers open, read back and compared before it counts as written.

Other formats lie beside it, each read back and scored. What options take away first (`lighter`) is
told in Gaussians and dB. transform.json says how the scene that was trained became the scene that
is handed out.
"""

from __future__ import annotations

from pathlib import Path

import torch

from recon_cli.config.stages import ExportConfig
from recon_cli.context import StageContext, StageInputs, Summary
from recon_cli.errors import StageError, WorkspaceError
from recon_cli.export.coordinate_frame import Frame, frame_of
from recon_cli.export.exporter import Hand
from recon_cli.export.synthetic_cameras import refuse_without_views
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.scene.splats import Splats, transformed, with_rows
from recon_cli.workspace.atomic import write_json

TRANSFORM = "transform.json"


def run(config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes splats.ply, the other formats and transform.json, and returns what they hold."""
    if config.model == "pruned" and "prune" not in inputs.folders:
        raise StageError(
            "The pruned model was asked for, but there is none that is fresh.",
            hint="Run `recon prune` first, or export with --model base.")
    refuse_without_views(config, inputs)
    pruned = "prune" in inputs.folders and config.model != "base"
    frame = frame_of(config, inputs)
    splats = read_ply(inputs.folders["prune" if pruned else "train"] / "splats.ply")
    if not frame.similarity.is_identity:
        splats = transformed(splats, frame.similarity)
    hand = Hand(config, inputs, out, frame, ctx)
    splats, changes = hand.lightened(splats)
    path = out / "splats.ply"
    others = [name for name in config.formats if name != "ply"]
    with ctx.progress.bar("export", 2 + len(others), unit="file") as bar:
        write_ply(path, splats)
        bar.advance()
        verify(path, splats)
        bar.advance()
        files = {}
        for name in others:
            files[name] = hand.out_as(name, splats)
            bar.advance()
    _write_transform(out / TRANSFORM, frame)
    return {
        "model": "pruned" if pruned else "base", "file": "splats.ply", "gaussians": len(splats),
        "bytes": path.stat().st_size, "transform": frame.similarity.to_json(),
        **({"changes": [change.record() for change in changes]} if changes else {}),
        **({"files": files} if files else {}),
    }


def _write_transform(path: Path, frame: Frame) -> None:
    write_json(path, {
        "from": "the world of sfm, in which the scene was trained; without views, that of the file "
        "that was imported",
        "to": "splats.ply beside this file",
        "similarity": frame.similarity.to_json(),
        "measurement": frame.measured.to_json() if frame.measured else None,
    })


def verify(path: Path, splats: Splats) -> None:
    """Raises WorkspaceError unless the file reads back as exactly these Gaussians."""
    back = read_ply(path).with_degree(splats.sh_degree)
    for name, value in splats.parameters().items():
        read = getattr(back, name)
        if name == "sh_rest":  # rows of zeros at the end are read as no rows
            value, read = with_rows(value, len(splats)), with_rows(read, len(back))
        if not torch.equal(read, value):
            raise WorkspaceError(
                f"{path} reads back with another {name} than was written.",
                hint="Check the disk, then run `recon export --again`.")
