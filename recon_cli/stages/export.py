"""export: a .ply that other viewers open, read back and compared before it counts as written."""

from __future__ import annotations

from pathlib import Path

import torch

from recon_cli.config import ExportConfig
from recon_cli.errors import StageError, WorkspaceError
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.scene import Splats
from recon_cli.stages.context import StageContext, StageInputs, Summary


def run(config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes splats.ply and returns what it holds."""
    if config.model == "pruned" and "prune" not in inputs.folders:
        raise StageError(
            "The pruned model was asked for, but there is none that is fresh.",
            hint="Run `recon prune` first, or export with --model base.")
    pruned = "prune" in inputs.folders and config.model != "base"
    splats = read_ply(inputs.folders["prune" if pruned else "train"] / "splats.ply")
    path = out / "splats.ply"
    with ctx.progress.bar("export", 2, unit="file") as bar:
        write_ply(path, splats)
        bar.advance()
        verify(path, splats)
        bar.advance()
    return {
        "model": "pruned" if pruned else "base", "file": "splats.ply", "gaussians": len(splats),
        "bytes": path.stat().st_size,
    }


def verify(path: Path, splats: Splats) -> None:
    """Raises WorkspaceError unless the file reads back as exactly these Gaussians."""
    back = read_ply(path)
    for name, value in splats.parameters().items():
        if not torch.equal(getattr(back, name), value):
            raise WorkspaceError(
                f"{path} reads back with another {name} than was written.",
                hint="Check the disk, then run `recon export --again`.")
