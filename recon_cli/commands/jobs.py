"""Shared by verbs: make a job of the options, bring stages up to date."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from recon_cli.api.runs import OpenWorkspace, RunRequest
from recon_cli.commands.console import say
from recon_cli.commands.options import Call
from recon_cli.commands.sentences import report_outcome
from recon_cli.config import settings as layers
from recon_cli.config.settings import C, Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import TrainCallback
from recon_cli.pipeline.execute import Job
from recon_cli.progress import TqdmProgress
from recon_cli.stages import STAGES, Stage


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
        say(layers.to_toml(workspace.resolve(request)).removesuffix("\n"))
        return
    workspace.run(request, report_outcome)
    if list(stages) == ["evaluate"]:  # a run has more to show than its scores
        say((workspace.path / "evaluate" / "table.txt").read_text(encoding="utf-8"))


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
