"""`recon batch`: many captures, each as `recon run` does it."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.errors import ReconstructionError
from recon_cli.jobs.executor import NEEDS_GPU, start_executor
from recon_cli.jobs.shared_jobs import describe_failures
from recon_cli.pipeline.batch import CaptureResult, name_captures, run_batch
from recon_cli.progress import TqdmProgress, format_duration, hide_bars
from recon_cli.workspace.layout import hold_lock, make_folder


def _check_assignments(
    _ctx: click.Context, _parameter: click.Parameter, values: tuple[str, ...]
) -> tuple[str, ...]:
    settings.check(settings.merge(map(settings.parse_assignment, values)))
    return values


@verb("batch")
@click.argument(
    "inputs", metavar="INPUT...", nargs=-1, required=True, type=options.PathType())
@click.option(
    "--out", required=True, type=options.PathType(file_okay=False), metavar="DIR",
    help="Folder of the workspaces, of batch.json and batch.html.")
@options.executor("Captures")
@options.with_prune
@click.option(
    "--set", "assignments", multiple=True, metavar="SECTION.FIELD=VALUE",
    callback=_check_assignments,
    help="Set an option of any stage, such as train.minutes=2; may be repeated.  [default: none]")
@click.option(
    "--config", "config_file", type=options.PathType(exists=True, dir_okay=False),
    help="TOML file with options.  [default: none]")
@options.compute(trains=True)
@options.again
@options.verbosity
@pass_call
def batch(
    call: Call, inputs: tuple[Path, ...], out: Path, place: str, jobs: int | None,
    with_prune: bool, assignments: tuple[str, ...], config_file: Path | None,
) -> None:
    """Reconstruct many captures, each in a workspace of its own.

    Each INPUT (a video, a folder of photos, a data set with poses) is a capture, reconstructed as
    by `recon run` in DIR/<name of INPUT>. Rerun the command to finish the rest. A failed capture
    does not stop the others. The exit code is 0 only if every capture has a scene.
    """
    compute = settings.build(ComputeConfig, call.settings)
    words = [word for text in assignments for word in ("--set", text)]
    words += ["--config", str(config_file.absolute())] if config_file else []
    words += [] if with_prune else ["--no-prune"]
    words += ["--device", compute.device, "--backend", compute.backend]
    words += [] if compute.max_memory is None else ["--max-memory", str(compute.max_memory)]
    words += ["--again"] * call.again + ["-v"] * call.verbose
    captures = name_captures(inputs, out)
    make_folder(out)
    with hold_lock(out, "batch", other="another folder with --out"):
        executor, threads = start_executor(
            place, out, inputs=inputs, slots=jobs, cores=compute.threads,
            gpu=NEEDS_GPU[compute.device])
        try:
            results = run_batch(
                captures, out, [*words, "--threads", str(threads)], executor, TqdmProgress(),
                _report)
        finally:
            executor.close()
    from recon_cli.report.batch_page import batch_text, write_batch_page

    page = write_batch_page(results, out)
    say(batch_text(results))
    say(f"The page of this table is {page}")
    done = [result.capture for result in results if result.succeeded]
    if done:
        say(f"next:    recon view -w {shlex.quote(str(out / done[0]))}")
    failed = {result.capture: result.reason for result in results if not result.succeeded}
    if failed:
        raise ReconstructionError(
            describe_failures(failed, len(results), "captures"),
            hint=f"The reasons are in {page}, too; rerun the command to try these again.")


def _report(result: CaptureResult) -> None:
    """Prints one line about a capture that has ended."""
    with hide_bars():
        if result.succeeded:
            score = "" if result.psnr_db is None else f"{result.psnr_db:.2f} dB, "
            say(f"{result.capture}: {score}{result.gaussians or 0:,} Gaussians "
                       f"({format_duration(result.seconds or 0.0)})")
        else:
            say(f"{result.capture}: exit code {result.exit_code}: {result.reason}")
