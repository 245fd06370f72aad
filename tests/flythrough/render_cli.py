"""`recon render` in process, and what it leaves."""

import json

import torch
from scenes import random_splats

from recon_cli.cli import main

SHORT = ["--fps", "4", "--seconds", "1"]


def splats(seed):
    made = random_splats(60, seed=seed, dtype=torch.float32)
    made.means[:, 2] = 3 + 0.3 * made.means[:, 2]
    return made


def render(workspace, *words):
    return main(["render", "-w", str(workspace), "--threads", "1", *map(str, words)])


def pictures(folder, kind="rgb"):
    return sorted(path.name for path in (folder / kind).iterdir())


def times(folder):
    return {path.name: path.stat().st_mtime_ns for path in (folder / "rgb").iterdir()}


def record(folder):
    return json.loads((folder / "render.json").read_text())
