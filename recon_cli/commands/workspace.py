"""The verbs that look at a workspace or tidy it: status, clean, report."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.jobs import open_job
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.commands.sentences import describe_summary
from recon_cli.errors import name_command
from recon_cli.pipeline import plan
from recon_cli.pipeline.clean import CleanItem, find_states, free_space
from recon_cli.pipeline.plan import Job, StageStatus
from recon_cli.progress import format_duration, format_megabytes
from recon_cli.stages import STAGES
from recon_cli.workspace.layout import Workspace, size_of
from recon_cli.workspace.manifest import describe_progress

logger = logging.getLogger("recon")


@verb("status")
@click.option(
    "--json", "as_json", is_flag=True,
    help="Print JSON: workspace, and stages with name, state, reasons, done, total, seconds, "
         "summary, notices.  [default: off]")
@options.common()
@pass_call
def status(call: Call, as_json: bool) -> None:
    """Show which stages are fresh, stale and why, or missing."""
    job = open_job(call)
    stages = plan.status(job)
    if as_json:
        say(json.dumps({
            "workspace": str(job.workspace.root),
            "stages": [dataclasses.asdict(stage) for stage in stages]}, indent=1))
        _refuse_damaged(job, stages)
        return
    if not job.workspace.root.exists():
        logger.warning("no workspace at %s yet", job.workspace.root)
    say(status_table(stages))
    for stage in stages:
        if stage.state == "fresh" and (lines := stage.summary.get("poorly_seen")):
            from recon_cli.workspace.records import name_photos  # imports numpy

            say(name_photos(job.workspace.folder("ingest"))("\n".join(lines)))
        for notice in stage.notices:
            logger.warning("%s: %s", stage.name, notice)
    _offer("--renders", job.workspace.renders(), job.workspace)
    _refuse_damaged(job, stages)


def _refuse_damaged(job: Job, stages: Sequence[StageStatus]) -> None:
    """Raises ManifestError for the first stage whose manifest cannot be trusted."""
    for stage in stages:
        if stage.state == "damaged":
            job.workspace.manifest(stage.name)


def status_table(stages: Sequence[StageStatus]) -> str:
    """Returns stage, state, time, and reasons or a sentence, one line a stage."""
    rows = [("stage", "state", "time", "")]
    for stage in stages:
        state = stage.state
        if state == "partial":
            state = f"partial ({describe_progress(stage.done, stage.total)})"
        elif state == "fresh" and stage.total:  # a training continues it
            state = f"fresh, continuing ({describe_progress(stage.done, stage.total)})"
        time = "" if stage.seconds is None else format_duration(stage.seconds)
        rows.append((
            stage.name, state, time,
            "; ".join(stage.reasons) or describe_summary(stage.name, stage.summary)))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=True))
             for row in rows]
    return "\n".join(line.rstrip() for line in lines)


@verb("clean")
@click.argument(
    "stages", metavar="[STAGE]...", nargs=-1, type=click.Choice(
        [row.name for top in STAGES for row in (top, *top.parts)]))
@click.option(
    "--states", is_flag=True,
    help="Also remove the states midway and at the end of a training; without them a longer one "
         "begins anew, and prune needs `recon train --again`.  [default: off]")
@click.option(
    "--renders", is_flag=True,
    help="Also remove the folders of frames and videos that `recon render` made in the workspace.  "
         "[default: off]")
@click.option(
    "--keep-exports", is_flag=True,
    help="Remove all results but the exported files.  [default: off]")
@click.option("--dry-run", is_flag=True, help="Only list the files and sizes.  [default: off]")
@options.common()
@pass_call
def clean(
    call: Call, stages: tuple[str, ...], states: bool, renders: bool, keep_exports: bool,
    dry_run: bool,
) -> None:
    """Free disk space.

    Without STAGE, removes unfinished work and scratch files and keeps every finished result. With
    STAGE, removes the results of those stages. Files are listed with their sizes first; exports
    are removed only by `recon clean export`.
    """
    if stages and (states or renders or keep_exports):
        raise click.UsageError("STAGE excludes --states, --renders and --keep-exports.")
    job = Job(Workspace(call.workspace), table=STAGES)  # recon.toml may be damaged
    freed = free_space(
        job, stages, states=states, renders=renders, keep_exports=keep_exports, dry=dry_run,
        show=lambda removals: _list_removals(job, removals))
    outcome = "would be freed" if dry_run else "freed"
    say(f"{format_megabytes(sum(item.size for item in freed))} {outcome}")
    if not stages and not keep_exports:
        _offer("--states", [] if states else find_states(job), job.workspace)
        _offer("--renders", [] if renders else job.workspace.renders(), job.workspace)


def _offer(option: str, paths: Sequence[Path], workspace: Workspace) -> None:
    """Says what an option of clean would free."""
    if paths:
        logger.info("%s frees %s more: %s", name_command(f"clean {option}"),
                    format_megabytes(sum(map(size_of, paths))),
                    ", ".join(str(path.relative_to(workspace.root)) for path in paths))


def _list_removals(job: Job, removals: Sequence[CleanItem]) -> None:
    """Prints what is removed, by stage, with sizes."""
    for stage in dict.fromkeys(item.stage for item in removals):
        own = [item for item in removals if item.stage == stage]
        say(f"{stage or 'scratch'}: {format_megabytes(sum(item.size for item in own))}")
        for item in own:
            link = " (a link; its target stays)" * item.is_link
            say(f"  {item.path.relative_to(job.workspace.root)}: "
                       f"{format_megabytes(item.size)}{link}")


@verb("report")
@click.option(
    "-o", "--out", type=options.PathType(), metavar="FILE.html",
    help="File to write.  [default: report.html in the workspace]")
@options.common()
@pass_call
def report(call: Call, out: Path | None) -> None:
    """Write an HTML report: capture, scores, views, settings.

    It is one file that any browser opens without a network. No stage is run; the report names
    missing or stale results, with the command to type.
    """
    from recon_cli.report.build import write_report

    path = write_report(open_job(call), out)
    say(f"{path}: {format_megabytes(path.stat().st_size)}")
