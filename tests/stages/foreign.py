"""Scenes of known truth to import, and workspaces with and without views of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
from prepared_workspace import make_workspace
from scenes import random_splats

from recon_cli.cli import main
from recon_cli.scene.splats import Splats


def truth() -> Splats:
    """The scene of tiny_scene's views, of degree 0."""
    found = random_splats(60, seed=0, dtype=torch.float32)
    found.means[:, 2] = 3 + 0.3 * found.means[:, 2]
    found.log_scales.clamp_(min=-2.0, max=-1.5)
    return found.with_degree(0)


def with_views(folder: Path) -> Path:
    """A workspace with views of the truth and without a scene."""
    workspace = make_workspace(folder, truth())
    shutil.rmtree(workspace / "train")
    return workspace


def recon(verb: str, workspace: Path, *words: object) -> int:
    """The exit code of a verb, in process."""
    return main([verb, "-w", str(workspace), "--threads", "1", *map(str, words)])
