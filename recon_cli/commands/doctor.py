"""What this machine has to offer: programs, rasterizers, memory, disk."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from recon_cli import machine

if TYPE_CHECKING:  # at run time it would import torch
    from recon_cli.render.registry import BackendStatus


@dataclass(frozen=True)
class Findings:
    """What `recon doctor --json` prints under these names.

    Attributes:
        versions: of Python, recon and the packages that matter.
        device: the GPU by name, or "cpu".
        backends: every rasterizer, the fastest first.
        cores: CPU cores that this process may use.
        memory_total_bytes: RAM.
        memory_free_bytes: RAM that is available now.
        disk_free_bytes: where the workspace lies or would lie.
        workspace: its path.
        writable: whether files can be made there.
    """

    versions: dict[str, str]
    device: str
    backends: tuple[BackendStatus, ...]
    cores: int
    memory_total_bytes: int
    memory_free_bytes: int
    disk_free_bytes: int
    workspace: str
    writable: bool


def examine(workspace: Path) -> Findings:
    """Returns what was found on this machine and at `workspace`, which need not exist."""
    import torch

    from recon_cli.render.registry import available_backends

    root = workspace.absolute()
    place = next(path for path in (root, *root.parents) if path.exists())
    memory = psutil.virtual_memory()
    return Findings(
        versions=machine.versions(),
        device=torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        backends=available_backends(),
        cores=machine.usable_threads(),
        memory_total_bytes=memory.total,
        memory_free_bytes=memory.available,
        disk_free_bytes=shutil.disk_usage(place).free,
        workspace=str(root),
        writable=place.is_dir() and os.access(place, os.W_OK | os.X_OK),
    )
