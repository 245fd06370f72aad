"""The end of a run: what was made, where it lies, how good it is, and what to type next."""

from __future__ import annotations

import os
import shlex
import webbrowser
from pathlib import Path

import click

from recon_cli.commands.jobs import open_job
from recon_cli.commands.options import Call
from recon_cli.pipeline.plan import check_parts
from recon_cli.progress import format_megabytes
from recon_cli.workspace.records import name_photos, read_frame_list
from recon_cli.workspace.summaries import ExportSummary, SfmSummary


def end_run(call: Call, *, open_page: bool = False) -> None:
    """Writes the report, and prints the results of a run that is complete."""
    from recon_cli.report.build import FILE, write_report
    from recon_cli.trust.quality import read_quality

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
    click.echo("")
    for name, path in (("scene", folder / export.file), ("page", page), ("report", report)):
        if path is not None:
            click.echo(f"{name + ':':9}{path} ({format_megabytes(path.stat().st_size)})")
    sfm = job.workspace.manifest("sfm")
    ingest = job.workspace.folder("ingest")
    quality = read_quality(
        job.workspace.folder("evaluate"), SfmSummary.from_json(sfm.run.summary) if sfm else None,
        read_frame_list(ingest).frames)
    click.echo(f"quality: {name_photos(ingest)(str(quality))}")
    click.echo(f"next:    {_next_command(call.workspace, page)}")
    if open_page:
        webbrowser.open((page or report).resolve().as_uri())


def _next_command(workspace: Path, page: Path | None) -> str:
    """Returns what to do with the results."""
    if page is None:
        return name_workspace("recon view", workspace)
    return (f"open {page.name} in a browser or send it; "
            f"{name_workspace('recon render --tour --out walk.mp4', workspace)}")


def name_workspace(command: str, workspace: Path) -> str:
    """Returns a command with the workspace, unless it is the one that is taken without -w."""
    usual = Path(os.environ.get("RECON_WORKSPACE") or "workspace")
    return command if workspace == usual else f"{command} -w {shlex.quote(str(workspace))}"
