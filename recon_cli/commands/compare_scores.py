"""`recon eval A B C`: brings every workspace's scores up to date and puts them into one table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from recon_cli.commands.usage import suggest_command
from recon_cli.config.stages import EvaluateConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, InputError
from recon_cli.evaluation.comparison import (
    ScoredModel,
    format_comparison,
    read_workspace_scores,
    score_file,
)
from recon_cli.evaluation.reference_views import load_held_out_views
from recon_cli.io.training_scene import load_scene
from recon_cli.io.views import ReferenceView
from recon_cli.pipeline import execute, plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.plan import Target
from recon_cli.stages import stage
from recon_cli.train.fit.train_data import read_config
from recon_cli.train.plan import QUALITIES
from recon_cli.workspace.layout import Workspace


def compare(
    open_job: Callable[[Path], tuple[Job, EvaluateConfig]], workspace: Path,
    items: Sequence[Path], form: str, *, caption: str = "", label: str = "",
) -> str:
    """Returns the scores of several workspaces and files, in their order.

    Files are scored on the held-out views of `workspace`, in whose world they must lie. `open_job`
    returns the job and the options of a workspace; `form` is text, markdown, csv, json or latex,
    which takes `caption` and `label`.
    InputError if an item is neither a workspace nor a file.
    """
    _check_items(items)
    short = {path: path.resolve().name for path in items}
    shared = Counter(short.values())
    names = {path: name if shared[name] == 1 else str(path) for path, name in short.items()}
    models: list[ScoredModel] = []
    held_out: tuple[str, list[ReferenceView], StageContext] | None = None
    for path in items:
        if Workspace(path).holds_results:
            job, config = open_job(path)
            plan.run(job, "eval", [Target("evaluate", config)])
            models += read_workspace_scores(names[path], job.workspace.folder("evaluate"))
        else:
            held_out = held_out or _load_held_out(*open_job(workspace))
            models.append(score_file(path, names[path], *held_out))
    return format_comparison(models, form, caption=caption, label=label)


def _check_items(items: Sequence[Path]) -> None:
    """Raises InputError or ConfigError unless each path is a workspace or a file, none twice."""
    resolved = set()
    for path in items:
        if not path.exists():
            raise InputError(f"{path} does not exist.", hint="Check the path.")
        if path.is_dir() and not Workspace(path).holds_results:
            raise InputError(
                f"{path} is neither a workspace nor a file of Gaussians.",
                hint=suggest_command("", [str(path)]))
        if path.resolve() in resolved:
            raise ConfigError(f"{path} appears twice.", hint="Remove one of them.")
        resolved.add(path.resolve())


def _load_held_out(
    job: Job, config: EvaluateConfig
) -> tuple[str, list[ReferenceView], StageContext]:
    """Returns the name of the workspace of -w, its held-out views, and where to render them."""
    plan.require(job.inspect(), ("ingest", "place"), "eval")
    inputs = StageInputs({name: job.workspace.folder(name) for name in ("ingest", "place")})
    max_size = config.max_size
    if max_size is None:
        trained = job.inspect().check("train").usable
        max_size = (read_config(job.workspace.folder("train")) if trained
                    else QUALITIES["normal"]).max_size
    ctx = execute.stage_context(job, stage("evaluate"), lambda _done, _total: None)
    views = load_held_out_views(load_scene(inputs.folders, validation=0.0), max_size, ctx)
    return job.workspace.root.name, views, ctx
