"""The verb `recon doctor`: versions, rasterizers, memory and disk of this machine."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click
import psutil

from recon_cli import machine
from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.options import Call, pass_call, verb

if TYPE_CHECKING:  # they import torch
    from recon_cli.render.registry import BackendStatus
    from recon_cli.render.self_check import Verdict


@verb("doctor")
@click.option("--json", "as_json", is_flag=True, help="Print the same as JSON.  [default: off]")
@options.common()
@pass_call
def doctor(call: Call, as_json: bool) -> None:
    """Show versions, rasterizers, memory and disk."""
    findings = examine(call.workspace)
    say(json.dumps(dataclasses.asdict(findings), indent=1) if as_json
               else findings_text(findings))


@dataclass(frozen=True)
class Findings:
    """The facts that `recon doctor --json` prints under these names."""

    versions: dict[str, str]  # of Python, recon and the packages that matter
    device: str  # the GPU by name, or "cpu"
    backends: tuple[BackendStatus, ...]  # every rasterizer, the fastest first
    cores: int  # CPU cores that this process may use
    memory_total_bytes: int
    memory_free_bytes: int  # available now
    disk_free_bytes: int  # where the workspace lies or would lie
    workspace: str  # its path
    writable: bool  # files can be made there
    bridge: str  # "installed", "damaged" or "missing": the learned features for photos
    self_check: Verdict | None  # of the triton kernels on this GPU; None where they cannot run


def examine(workspace: Path) -> Findings:
    """Returns the facts on this machine, and on `workspace`, which need not exist."""
    import torch

    from recon_cli.render import registry
    from recon_cli.sfm.features import xfeat_weights

    cuda = torch.cuda
    root = workspace.absolute()
    place = next(path for path in (root, *root.parents) if path.exists())
    memory = psutil.virtual_memory()
    return Findings(
        versions=machine.versions(),
        device=cuda.get_device_name() if cuda.is_available() else "cpu",
        backends=registry.available_backends(),
        cores=machine.usable_threads(),
        memory_total_bytes=memory.total,
        memory_free_bytes=memory.available,
        disk_free_bytes=shutil.disk_usage(place).free,
        workspace=str(root),
        writable=place.is_dir() and os.access(place, os.W_OK | os.X_OK),
        bridge="missing" if not xfeat_weights.are_installed() else (
            "damaged" if xfeat_weights.load_weights() is None else "installed"),
        self_check=registry.cuda_verdict(),
    )


def findings_text(findings: Findings) -> str:
    """Returns the findings, one line each."""
    lines = [f"{name:<13} {version}" for name, version in findings.versions.items()]
    lines.append(f"{'device':<13} {findings.device}")
    for backend in findings.backends:
        state = f"missing: {backend.missing}" if backend.missing else (
            "runs on " + ", ".join(backend.devices))
        lines.append(f"{'backend':<13} {backend.name}: {state}")
    check = findings.self_check
    if check is not None:
        outcome = f"passed in {check.seconds:.1f} s" if check.passed else (
            f"FAILED, torch is used instead: {check.failure}")
        lines.append(f"{'self-check':<13} {check.backend} on {check.device}: {outcome}")
    advice = "" if findings.bridge == "installed" else (
        "; `recon setup bridge` gets the learned features that match photos taken far apart")
    lines.append(f"{'bridge':<13} {findings.bridge}{advice}")
    writable = "writable" if findings.writable else "NOT writable"
    lines += [
        f"{'cores':<13} {findings.cores}",
        f"{'memory':<13} {findings.memory_free_bytes / 1e9:.1f} GB free of "
        f"{findings.memory_total_bytes / 1e9:.1f} GB",
        f"{'disk':<13} {findings.disk_free_bytes / 1e9:.1f} GB free",
        f"{'workspace':<13} {findings.workspace} ({writable})",
    ]
    return "\n".join(lines)
