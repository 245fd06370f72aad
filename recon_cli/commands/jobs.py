"""Shared by verbs: make a job of the options, bring stages up to date, print the outcome."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from recon_cli.api.runs import OpenWorkspace, RunRequest
from recon_cli.commands.options import Call
from recon_cli.commands.sentences import describe_summary
from recon_cli.config import settings as layers
from recon_cli.config.settings import C, Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import TrainCallback
from recon_cli.jobs.executor import NEEDS_GPU, Executor, start_executor
from recon_cli.pipeline.execute import Job, Outcome
from recon_cli.progress import TqdmProgress, format_duration
from recon_cli.stages import STAGES, Stage

logger = logging.getLogger("recon")


def run_stages(
    call: Call, verb: str, stages: Sequence[str], *, sources: tuple[Path, ...] = (),
    base: Settings | None = None, forced: Settings | None = None,
    callbacks: tuple[TrainCallback, ...] = (), table: Sequence[Stage] = (),
) -> None:
    """Runs stages one after the other, or prints their options.

    `verb` is named to other processes that want the workspace; `sources` are the user's files, for
    ingest. `base` are defaults, over which recon.toml, --config and options win; `forced` wins over
    everything. An empty `table` stands for STAGES.
    """
    request = RunRequest(
        verb, tuple(stages), sources, base or {}, call.settings, forced or {}, again=call.again,
        from_import=call.from_import, callbacks=callbacks, table=tuple(table),
        deadline=call.deadline)
    workspace = open_workspace(call)
    if call.print_config:
        click.echo(layers.to_toml(workspace.resolve(request)), nl=False)
        return
    workspace.run(request, report_outcome)
    if list(stages) == ["evaluate"]:  # a run has more to show than its scores
        click.echo((workspace.path / "evaluate" / "table.txt").read_text(encoding="utf-8"))


def open_workspace(call: Call) -> OpenWorkspace:
    """Returns the workspace of a command line, with what -w, --config and --set say."""
    return OpenWorkspace(
        call.workspace, call.config_file, call.assigned, TqdmProgress(), tuple(STAGES))


def open_job(call: Call) -> Job:
    """Returns a job on the workspace for a verb that runs no stage."""
    return open_job_with(call, ComputeConfig)[0]


def open_job_with(call: Call, kind: type[C]) -> tuple[Job, C]:
    """Returns a job as `open_job` does, and the options of one config class."""
    return open_workspace(call).open_job(kind, call.settings)


def report_outcome(outcome: Outcome) -> None:
    """Prints one line about a stage: its result, or that it is up to date."""
    run = outcome.manifest.run
    if outcome.ran:
        sentence = describe_summary(outcome.stage, run.summary)
        logger.info(
            "%s (%s)", ": ".join(filter(None, [outcome.stage, sentence])),
            format_duration(run.seconds), extra=_of(outcome))
        return
    logger.info("%s is up to date", outcome.stage, extra=_of(outcome))
    for notice in run.summary.get("notices") or ():
        logger.warning("%s", notice)


def _of(outcome: Outcome) -> dict[str, Any]:
    """Returns the fields by which the log knows the end of a stage."""
    return {"outcome": outcome, "event": "done", "stage": outcome.stage,
            "seconds": outcome.manifest.run.seconds}


def open_executor(
    place: str, jobs: int | None, compute: ComputeConfig, folder: Path, inputs: Sequence[Path] = ()
) -> tuple[Executor, int]:
    """Returns the executor of commands on `folder`, and how many threads each command has."""
    return start_executor(
        place, folder, inputs=inputs, slots=jobs, cores=compute.threads,
        gpu=NEEDS_GPU[compute.device])
