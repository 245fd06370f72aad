"""What verbs have in common: a job from the options, and stages that are brought up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from recon_cli.commands import console, options
from recon_cli.commands.options import Call
from recon_cli.config import settings as layers
from recon_cli.config.settings import C, Settings
from recon_cli.config.stages import ComputeConfig, TrainConfig
from recon_cli.context import Nobody, Watcher
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Outcome, Target
from recon_cli.progress import TqdmProgress
from recon_cli.stages import STAGES
from recon_cli.workspace.layout import Workspace


def perform(
    call: Call,
    verb: str,
    stages: Sequence[str],
    *,
    sources: tuple[Path, ...] = (),
    base: Settings | None = None,
    forced: Settings | None = None,
    watcher: Watcher | None = None,
) -> None:
    """Runs stages one after the other, or prints their options.

    Args:
        call: what was typed.
        verb: what others who want the workspace are told.
        stages: by name, in the order of the table.
        sources: the user's files, for ingest.
        base: defaults of the verb; recon.toml, --config and options win over them.
        forced: what the verb itself means; it wins over everything.
        watcher: looks on while Gaussians are trained.
    """
    given = options.explicit(call)
    values = layers.merged([base or {}, given, _of_all_processes(call, given), forced or {}])
    rows = [row for row in STAGES if row.name in stages]
    configs = {row.name: layers.build(row.config, values) for row in rows}
    compute = layers.build(ComputeConfig, values)
    if call.print_config:
        click.echo(layers.to_toml({**configs, "compute": compute}), nl=False)
        return
    job = Job(
        Workspace(call.workspace), given, compute, TqdmProgress(), tell, STAGES,
        watcher or Nobody(), call.ranks)
    targets = [
        Target(row.name, configs[row.name], () if row.needs else sources) for row in rows]
    plan.run(job, verb, targets, again=call.again)
    if "evaluate" in stages:
        click.echo((job.workspace.folder("evaluate") / "table.txt").read_text(encoding="utf-8"))


def _of_all_processes(call: Call, given: Settings) -> Settings:
    """Returns the settings that were typed, with the views that all processes together take.

    `--batch-views` counts those of one process. What is recorded, and what files and --set say, are
    the views of a step: a result does not depend on who computed it.
    """
    own = call.settings.get("train", {}).get("batch_views")
    if own is None and "batch_views" not in given.get("train", {}):
        own = TrainConfig.batch_views
    together = {} if own is None else {"batch_views": own * call.ranks.count}
    return layers.merged([call.settings, {"train": together}])


def beside(call: Call, kind: type[C]) -> tuple[Job, C]:
    """Returns what a command needs that only looks at a stage, and the stage's options."""
    given = options.explicit(call)
    values = layers.merged([given, call.settings])
    compute = layers.build(ComputeConfig, values)
    job = Job(
        Workspace(call.workspace), given, compute, TqdmProgress(), table=STAGES, ranks=call.ranks)
    return job, layers.build(kind, values)


def tell(outcome: Outcome) -> None:
    """Says what became of a stage."""
    if outcome.ran:
        run = outcome.manifest.run
        click.echo(console.summary_line(outcome.stage, run.summary, run.seconds))
    else:
        click.echo(f"{outcome.stage} is up to date")
