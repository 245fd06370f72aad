"""Runs one stage: gives it a folder, a device and its inputs, and commits what it leaves."""

from __future__ import annotations

import dataclasses
import importlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from recon_cli import machine
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import ALONE, Nobody, Ranks, StageContext, StageInputs, Summary, Watcher
from recon_cli.errors import BackendError, ConfigError, ManifestError, ReconError
from recon_cli.pipeline.freshness import Inspection
from recon_cli.progress import NullProgress, Progress
from recon_cli.stages import STAGES, Stage
from recon_cli.workspace.digests import Source, read_source
from recon_cli.workspace.layout import Workspace, combined
from recon_cli.workspace.manifest import Basis, Manifest, RunRecord, Unfinished
from recon_cli.workspace.summaries import JsonRecord

_RECORD_SECONDS = 0.5  # a person sees no difference, and a flush to disk costs nothing at this pace

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Outcome:
    """What came of one stage: its result, and whether it had to be run for that."""

    stage: str
    manifest: Manifest
    ran: bool


def _say_nothing(_outcome: Outcome) -> None:
    """Reports to nobody."""


@dataclass(frozen=True)
class Job:
    """Where to work and on what terms.

    Attributes:
        workspace: holds the results.
        settings: what recon.toml, --config and --set set.
        compute: device, backend and threads as asked for.
        progress: opens progress bars.
        report: called with every stage that is done or was already.
        table: the stages.
        watcher: looks on while Gaussians are trained; no part of what is computed.
        ranks: the processes that train together, which this one leads.
    """

    workspace: Workspace
    settings: Settings = field(default_factory=dict)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    progress: Progress = field(default_factory=NullProgress)
    report: Callable[[Outcome], None] = _say_nothing
    table: Sequence[Stage] = STAGES
    watcher: Watcher = field(default_factory=Nobody)
    ranks: Ranks = ALONE

    def inspect(self) -> Inspection:
        """Returns a look at the workspace as it is now."""
        return Inspection(self.workspace, self.settings, self.table)


def run_stage(
    job: Job,
    look: Inspection,
    row: Stage,
    config: StageConfig,
    sources: tuple[Source, ...] | None = None,
) -> Manifest:
    """Runs one stage whose needs are fresh, commits its result and returns the manifest.

    Args:
        job: where and how.
        look: at the workspace as it is now.
        row: the stage.
        config: its options.
        sources: the user's files; None means those of the last time.

    Raises:
        ReconError: whatever the stage raises; what it had finished stays for the next try.
    """
    if sources is None:
        sources = () if row.needs else _remembered(job, row)
    basis = Basis(row.name, row.version, config.hashed_fields(), sources, look.upstream(row))
    _say_what_is_left_out(look, row)
    inputs = StageInputs(
        {name: job.workspace.folder(name) for name, digest in basis.upstream.items() if digest},
        tuple(Path(source.path) for source in sources))
    logger.debug("%s: running with %s", row.name, config)
    out, earlier = job.workspace.begin(basis)
    with machine.Meter() as meter, _no_trace_of_nothing(job.workspace, row.name):
        ctx = context_for(job, row, _recorder(job.workspace, earlier, meter))
        summary = importlib.import_module(row.module).run(config, inputs, out, ctx)
    outputs = job.workspace.seal(row.name)
    manifest = Manifest(
        basis, outputs, combined(outputs, row.volatile),
        _run_record(row, ctx, meter, earlier, summary))
    job.workspace.commit(manifest)
    logger.debug("%s: finished in %.1f s", row.name, manifest.run.seconds)
    return manifest


@contextmanager
def _no_trace_of_nothing(workspace: Workspace, stage: str) -> Iterator[None]:
    """Discards the unfinished work of a stage that failed before anything was worth resuming."""
    try:
        yield
    except ReconError:
        unfinished = workspace.unfinished(stage)
        if unfinished and unfinished.total == 0:
            workspace.discard(stage)
        raise


def _run_record(
    row: Stage, ctx: StageContext, meter: machine.Meter, earlier: Unfinished,
    summary: JsonRecord | Summary,
) -> RunRecord:
    return RunRecord(
        seconds=round(earlier.seconds + meter.seconds, 3),
        peak_memory_bytes=meter.peak_memory_bytes,
        summary=summary.to_json() if isinstance(summary, JsonRecord) else summary,
        versions=machine.versions(),
        device=ctx.device if row.renders else None,
        backend=ctx.backend if row.renders else None,
        threads=ctx.threads,
        finished=datetime.now().astimezone().isoformat(timespec="seconds"),
    )


def _say_what_is_left_out(look: Inspection, row: Stage) -> None:
    for name in row.uses:
        check = look.check(name)
        if check.manifest and not check.fresh:
            logger.warning("%s is left out of %s: it is %s", name, row.verb, check.described())


def last_sources(job: Job, stage: str) -> tuple[Source, ...]:
    """Returns the user's files of a stage's last run as they were then; none if unknown."""
    try:
        latest = job.workspace.unfinished(stage) or job.workspace.manifest(stage)
    except ManifestError:  # whoever needs more than a guess reads the manifest himself
        latest = None
    return latest.basis.sources if latest else ()


def _remembered(job: Job, row: Stage) -> tuple[Source, ...]:
    """Returns the sources of the last run, read again."""
    sources = last_sources(job, row.name)
    if not sources:
        raise ConfigError(
            f"{row.verb} needs an input: none was given and {job.workspace.root} remembers none.",
            hint=f"Type `recon {row.verb} {row.takes}`"
            f"{', or a folder of photos in place of VIDEO' * (row.takes == 'VIDEO')}.")
    return tuple(
        read_source(Path(source.path), known=source, without=job.workspace.root)
        for source in sources)


def _recorder(
    workspace: Workspace, earlier: Unfinished, meter: machine.Meter
) -> Callable[[int, int], None]:
    """Returns the function behind `StageContext.record`; it writes at most twice a second."""
    last = float("-inf")

    def record(done: int, total: int) -> None:
        nonlocal last
        if done == total or time.monotonic() - last >= _RECORD_SECONDS:
            last = time.monotonic()
            workspace.record(dataclasses.replace(
                earlier, done=done, total=total, seconds=earlier.seconds + meter.seconds))

    return record


def context_for(job: Job, row: Stage, record: Callable[[int, int], None]) -> StageContext:
    """Returns what a stage is given, with device and threads set up."""
    if row.renders:
        return dataclasses.replace(
            rendering(job.compute, job.progress, job.ranks), record=record, watcher=job.watcher)
    threads = job.compute.threads or machine.usable_threads()
    return StageContext(progress=job.progress, threads=threads, record=record)


def rendering(
    compute: ComputeConfig, progress: Progress, ranks: Ranks = ALONE
) -> StageContext:
    """Returns where to train and render, once the rasterizer is ready.

    Args:
        compute: device, backend and threads as asked for.
        progress: opens progress bars.
        ranks: that train together; each takes its share of the cores.

    Raises:
        BackendError: what was asked for is not there.
    """
    # Importing torch takes seconds, which status and --help must not pay.
    from recon_cli.render import registry  # noqa: PLC0415

    threads = compute.threads or ranks.threads_of(machine.usable_threads())
    backend, device = _resolved(compute, ranks)
    registry.use_threads(backend, threads)
    _prepare_kernels(progress, backend)
    return StageContext(progress, device, backend, threads, ranks=ranks)


def _resolved(compute: ComputeConfig, ranks: Ranks) -> tuple[str, str]:
    """Returns (backend, device) to train and render with.

    Raises:
        BackendError: what was asked for is not there, or not for every process.
    """
    from recon_cli.render import registry  # noqa: PLC0415 (imports torch)

    backend, device = registry.resolve(compute.backend, compute.device)
    if device == "cuda" and ranks.lacks_gpu:
        raise BackendError(
            f"{ranks.count} processes were started, but some of them have no GPU of their own.",
            hint="Give torchrun as many processes a machine as it has GPUs (--nproc-per-node gpu), "
            "or train with --device cpu.")
    return backend, device


def _prepare_kernels(progress: Progress, backend: str) -> None:
    """Loads the kernels of a backend, or compiles them with something to look at."""
    from recon_cli.render import registry  # noqa: PLC0415 (imports torch)

    count = registry.kernels_to_compile(backend)
    if not count:  # kernels that turn out to be damaged are compiled here too
        registry.prepare(backend, lambda: None)
        return
    with progress.bar("compile for this CPU, once", count, unit="kernel") as bar:
        seconds = registry.prepare(backend, bar.advance)
    logger.info("kernels compiled in %.1f s", seconds)


def refuse_missing_backend(job: Job, stages: Sequence[str]) -> None:
    """Fails before hours of other work where a device or backend was named that is not here.

    Raises:
        BackendError: one of `stages` renders, and what it would render with cannot be had.
    """
    named = (job.compute.device, job.compute.backend) != ("auto", "auto")
    doubtful = named or job.ranks.lacks_gpu
    if doubtful and any(row.renders for row in job.table if row.name in stages):
        _resolved(job.compute, job.ranks)
