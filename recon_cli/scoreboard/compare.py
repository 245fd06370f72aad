"""`recon eval A B C`: brings every workspace's scores up to date and sets them side by side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
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

Open = Callable[[Path], tuple[Job, EvaluateConfig]]


def compared(opened: Open, workspace: Path, items: Sequence[Path]) -> list[Entry]:
    """Returns the scores of several workspaces and files, in their order.

    Files are scored on the held-out views of one workspace, in whose world they must lie.

    Args:
        opened: returns the job and the options of a workspace, its own recon.toml among them.
        workspace: that of -w.
        items: workspaces and files, at least one.

    Raises:
        InputError: a path is neither.
        StageError: a workspace has no fresh model, or the one of -w no fresh cameras.
    """
    checked(items)
    names = _names(items)
    entries: list[Entry] = []
    views: Benchmark | None = None
    for path in items:
        if Workspace(path).holds_results:
            job, config = opened(path)
            pipeline.run(job, "eval", [Target("evaluate", config)])
            entries += of_workspace(names[path], job.workspace.folder("evaluate"))
        else:
            views = views or _views(*opened(workspace))
            entries.append(of_file(path, names[path], views))
    return entries


def _names(items: Sequence[Path]) -> dict[Path, str]:
    """Returns what tables call each path: its last part, or where two share that, all of it."""
    short = {path: path.resolve().name for path in items}
    shared = Counter(short.values())
    return {path: name if shared[name] == 1 else str(path) for path, name in short.items()}


def _views(job: Job, config: EvaluateConfig) -> Benchmark:
    """Returns the held-out views of the workspace of -w."""
    row = stage("evaluate")
    pipeline.require_fresh(job, ("ingest", "sfm"))
    folders = {name: job.workspace.folder(name) for name in ("ingest", "sfm")}
    if job.inspect().check("train").fresh:
        folders["train"] = job.workspace.folder("train")
    context = execute.context_for(job, row, lambda _done, _total: None)
    return benchmark_of(
        job.workspace.root.name, StageInputs(folders), config.max_size, context)
