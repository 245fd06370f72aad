"""Shared by verbs: make a job of the options, bring stages up to date, print the outcome.

The end of a run says what was made, where it lies, how good it is, and what to type next.
"""

from __future__ import annotations

import logging
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recon_cli.api.runs import OpenWorkspace, RunRequest
from recon_cli.commands.console import say
from recon_cli.commands.options import Call
from recon_cli.commands.sentences import describe_summary
from recon_cli.config import settings as layers
from recon_cli.config.settings import C, Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import TrainCallback
from recon_cli.errors import command_line
from recon_cli.jobs.executor import NEEDS_GPU, Executor, start_executor
from recon_cli.pipeline.execute import Job, Outcome
from recon_cli.pipeline.plan import check_parts
from recon_cli.progress import TqdmProgress, format_duration, format_megabytes
from recon_cli.stages import STAGES, Stage
from recon_cli.workspace.summaries import ExportSummary, PlaceSummary

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


def end_run(call: Call, *, open_page: bool = False) -> None:
    """Writes the report, and prints the results of a run that is complete."""
    from recon_cli.report.build import FILE, write_report
    from recon_cli.trust.quality import read_quality
    from recon_cli.workspace.records import name_photos, read_frame_list  # imports numpy

    job = open_job(call)
    folder = job.workspace.folder("export")
    manifest = job.workspace.manifest("export")
    assert manifest is not None, "the run has exported"
    export = ExportSummary.from_json(manifest.run.summary)
    write_report(job, None)
    report = job.workspace.root / FILE
    page = next((folder / check.manifest.run.summary["file"]
                 for check in check_parts(job, "export")
                 if check.row.part == "html" and check.manifest and check.fresh), None)
    say("")
    for name, path in (("scene", folder / export.file), ("page", page), ("report", report)):
        if path is not None:
            say(f"{name + ':':9}{path} ({format_megabytes(path.stat().st_size)})")
    place = job.workspace.manifest("place")
    ingest = job.workspace.folder("ingest")
    quality = read_quality(
        job.workspace.folder("evaluate"),
        PlaceSummary.from_json(place.run.summary) if place else None,
        read_frame_list(ingest).frames)
    say(f"quality: {name_photos(ingest)(str(quality))}")
    say(f"next:    {_next_command(page)}")
    if open_page:
        webbrowser.open((page or report).resolve().as_uri())


def _next_command(page: Path | None) -> str:
    """Returns what to do with the results."""
    if page is None:
        return command_line("view")
    return (f"open {page.name} in a browser or send it; "
            f"{command_line('render --tour --out walk.mp4')}")
