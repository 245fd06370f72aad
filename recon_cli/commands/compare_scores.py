"""`recon eval A B C`: brings every workspace's scores up to date and sets them side by side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from recon_cli.config.stages import EvaluateConfig
from recon_cli.context import StageInputs
from recon_cli.evaluation.comparison import (
    Benchmark,
    Entry,
    benchmark_of,
    checked,
    of_file,
    of_workspace,
)
from recon_cli.pipeline import execute, plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.plan import Target
from recon_cli.stages import stage
from recon_cli.train.plan import QUALITIES
from recon_cli.train.runner import read_config
from recon_cli.workspace.layout import Workspace

FORMS = ("text", "markdown", "csv", "latex", "json")


def compare(
    opened: Callable[[Path], tuple[Job, EvaluateConfig]], workspace: Path, items: Sequence[Path],
    form: str,
) -> str:
    """Returns the scores of workspaces and files in one of FORMS; see `compare.compared`."""
    from recon_cli.evaluation.comparison import report

    return report(compared(opened, workspace, items), form)


def over_seeds(job: Job, config: EvaluateConfig, count: int, form: str) -> str:
    """Returns the scores of a workspace over seeds in one of FORMS; see `seeds.over_seeds`."""
    from recon_cli.experiments import seeds

    return seeds.over_seeds(job, config, count).text(form)


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
            plan.run(job, "eval", [Target("evaluate", config)])
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
    plan.require_fresh(job, ("ingest", "sfm"))
    folders = {name: job.workspace.folder(name) for name in ("ingest", "sfm")}
    max_size = config.max_size
    if max_size is None:
        trained = job.inspect().check("train").fresh
        max_size = (read_config(job.workspace.folder("train")) if trained
                    else QUALITIES["normal"]).max_size
    context = execute.context_for(job, row, lambda _done, _total: None)
    return benchmark_of(job.workspace.root.name, StageInputs(folders), max_size, context)
