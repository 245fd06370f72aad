"""`recon merge`, and `recon train --blocks`: a large scene in blocks, each trained by itself."""

from __future__ import annotations

import dataclasses

import click

from recon_cli.commands import options
from recon_cli.commands.jobs import open_executor, open_job_with, run_stages
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config.stages import MergeConfig, TrainConfig
from recon_cli.lazy import load
from recon_cli.pipeline.execute import Job, refuse_missing_backend
from recon_cli.pipeline.plan import refuse_to_replace, run_needs
from recon_cli.progress import hide_bars
from recon_cli.stages import MERGE, STAGES
from recon_cli.workspace.layout import hold_lock

_TABLE = tuple(MERGE if row.name == MERGE.name else row for row in STAGES)


@verb("merge")
@options.stage(MergeConfig, renders=True)
@pass_call
def merge(call: Call) -> None:
    """Put the blocks of `recon train --blocks` together.

    Each block keeps what lies in its cell; then all are fine-tuned together. `recon train --blocks`
    does this at its end; this command repeats it after a block was trained again by hand.
    """
    _merge(call)


def _merge(call: Call) -> None:
    job = open_job_with(call, MergeConfig)[0]
    blocks = () if call.print_config else load("recon_cli.pipeline.blocks.list_blocks")(
        job.workspace)
    run_stages(call, MERGE.verb, [MERGE.name], sources=tuple(block.model for block in blocks),
               table=_TABLE)


def train_in_blocks(call: Call, asked: str, place: str, jobs: int | None) -> bool:
    """Trains and merges a scene in blocks; returns False where it stays whole: nothing is done."""
    job, config = open_job_with(call, TrainConfig)
    if asked == "off" or (asked == "auto" and not _is_large(job)):
        return False
    refuse_missing_backend(job, [MERGE.name])
    if not call.again:
        refuse_to_replace(dataclasses.replace(job, table=_TABLE), "train --blocks", [MERGE.name])
    run_needs(job, "train", MERGE.name)
    count = load("recon_cli.pipeline.blocks.count_blocks")(job, asked)
    if count == 1:
        return False
    blocks = load("recon_cli.pipeline.blocks.cut_blocks")(job, count, config)
    folder = blocks[0].workspace.parent
    with hold_lock(folder, "train --blocks", other="another workspace with -w"):
        executor, threads = open_executor(place, jobs, job.compute, folder)
        words = ["--blocks", "off", "--threads", str(threads), "--device", job.compute.device,
                 "--backend", job.compute.backend]
        if job.compute.max_memory is not None:
            words += ["--max-memory", str(job.compute.max_memory)]
        words += ["--again"] * call.again + ["-v"] * call.verbose
        try:
            load("recon_cli.pipeline.blocks.train_blocks")(
                blocks, words, executor, job.progress, _report)
        finally:
            executor.close()
    own = {"merge": {"validation": config.validation}}
    _merge(dataclasses.replace(call, settings={**call.settings, **own}))
    return True


def _is_large(job: Job) -> bool:
    """Returns whether a capture has more frames than one model takes."""
    most = load("recon_cli.pipeline.blocks.MOST_VIEWS")
    ingest = job.workspace.manifest("ingest")
    return ingest is not None and int(ingest.run.summary.get("frames", 0)) > most


def _report(text: str) -> None:
    with hide_bars():
        click.echo(text)
