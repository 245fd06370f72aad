"""Options that make a scene of the sample video in seconds, and that scene."""

from __future__ import annotations

from pathlib import Path

from recon_cli.api import Workspace

TINY = {
    "ingest": {"frames": 16, "max_size": 320},
    "sfm": {"max_features": 1500, "accept_weak": True, "min_registered": 0.3},
    "train": {"iterations": 60, "max_size": 160, "max_gaussians": 3000, "background": "off",
              "exposure": "off", "images": "original", "sh_degree": 1},
    "prune": {"rounds": 1, "recovery": 10},
}


def write_options(folder: Path) -> None:
    """Writes them as the recon.toml of a workspace."""
    def toml(value: object) -> str:
        return str(value).lower() if isinstance(value, bool) else repr(value).replace("'", '"')

    folder.mkdir(exist_ok=True)
    (folder / "recon.toml").write_text("".join(
        f"[{section}]\n" + "".join(f"{name} = {toml(value)}\n" for name, value in values.items())
        for section, values in TINY.items()))


def make_room(folder: Path, video: Path) -> None:
    """Trains on a video in a workspace."""
    write_options(folder)
    room = Workspace(folder)
    room.ingest(video)
    room.train()
