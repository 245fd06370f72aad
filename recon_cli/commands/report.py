"""The verb `recon report`: what can be asked of it. What it needs is imported when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, pass_call
from recon_cli.pipeline.plan import Job
from recon_cli.progress import TqdmProgress
from recon_cli.workspace.layout import Workspace


@click.command("report")
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), metavar="FILE.html",
    help="File to write.  [default: report.html in the workspace]")
@options.common()
@pass_call
def report(call: Call, out: Path | None) -> None:
    """Write one page about the workspace: capture, scores, views, curves, settings.

    It opens without a network in any browser. No stage is run; what is missing or stale is said in
    its place, with the command to type.
    """
    from recon_cli.report.build import write

    job = Job(Workspace(call.workspace), options.explicit(call), progress=TqdmProgress())
    click.echo(write(job, out))
