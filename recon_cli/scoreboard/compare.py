"""`recon eval A B C`: brings every workspace's scores up to date and sets them side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from recon_cli import execute, pipeline
from recon_cli.config import EvaluateConfig
from recon_cli.execute import Job
from recon_cli.pipeline import Target
from recon_cli.scoreboard.entries import (
    Benchmark,
    Entry,
    benchmark_of,
    checked,
    of_file,
    of_workspace,
)
from recon_cli.stages import stage
from recon_cli.stages.context import StageInputs
from recon_cli.workspace import Workspace


def compared(job: Job, config: EvaluateConfig, items: Sequence[Path]) -> list[Entry]:
    """Returns the scores of several workspaces and files, in their order.

    Files are scored on the held-out views of the job's workspace, in whose world they must lie.

    Args:
        job: its workspace is the one of -w; others are worked on in the same terms.
        config: how views are scored.
        items: workspaces and files, at least one.

    Raises:
        InputError: a path is neither.
        StageError: a workspace has no fresh model, or the one of -w no fresh cameras.
    """
    checked(items)
    entries: list[Entry] = []
    views: Benchmark | None = None
    for path in items:
        if Workspace(path).holds_results:
            own = dataclasses.replace(job, workspace=Workspace(path))
            pipeline.run(own, "eval", [Target("evaluate", config)])
            entries += of_workspace(_name(path), own.workspace.folder("evaluate"))
        else:
            views = views or _views(job, config)
            entries.append(of_file(path, views))
    return entries


def _views(job: Job, config: EvaluateConfig) -> Benchmark:
    """Returns the held-out views of the workspace of -w."""
    row = stage("evaluate")
    pipeline.require_fresh(job, ("ingest", "sfm"))
    folders = {name: job.workspace.folder(name) for name in ("ingest", "sfm")}
    if job.inspect().check("train").fresh:
        folders["train"] = job.workspace.folder("train")
    context = execute.context_for(job, row, lambda _done, _total: None)
    return benchmark_of(
        _name(job.workspace.root), StageInputs(folders), config.max_size, context)


def _name(path: Path) -> str:
    return path.resolve().name
