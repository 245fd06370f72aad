"""Runs one stage: gives it a folder, a device and its inputs, and commits its output."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from recon_cli import machine
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import EarlierResult, StageContext, StageInputs, TrainCallback
from recon_cli.deadline import Deadline
from recon_cli.errors import ConfigError, InputError, ManifestError, ReconError, name_command
from recon_cli.pipeline.continuation import Start, find_start
from recon_cli.pipeline.freshness import WorkspaceCheck
from recon_cli.progress import NullProgress, Progress, in_stage, limit_rate
from recon_cli.stages import STAGES, Stage
from recon_cli.workspace.digests import Source, digest_file, digest_outputs, read_source
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import NAME as MANIFEST
from recon_cli.workspace.manifest import Manifest, PartialRun, ResultKey, RunRecord
from recon_cli.workspace.summaries import JsonRecord

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Outcome:
    """The result of one stage, and whether it was run for that."""

    stage: str
    manifest: Manifest
    ran: bool


@dataclass(frozen=True)
class Job:
    """A workspace, and the settings and devices to work with."""

    workspace: Workspace
    settings: Settings = field(default_factory=dict)  # what recon.toml, --config and --set set
    compute: ComputeConfig = field(default_factory=ComputeConfig)  # as typed
    progress: Progress = field(default_factory=NullProgress)  # opens progress bars
    report: Callable[[Outcome], None] = lambda _outcome: None  # gets each stage
    table: Sequence[Stage] = STAGES
    # called while Gaussians are trained; they do not affect the result
    callbacks: tuple[TrainCallback, ...] = ()
    shared: dict[Hashable, Any] = field(default_factory=dict)  # by a stage with its parts
    asked: tuple[str, ...] = ()  # the stages that run, where that is known
    deadline: Deadline = field(default_factory=Deadline)  # for what stages may do without

    def inspect(self) -> WorkspaceCheck:
        """Returns the checks of the workspace as it is now."""
        return WorkspaceCheck(self.workspace, self.settings, self.table)


def run_stage(
    job: Job, checks: WorkspaceCheck, row: Stage, config: StageConfig,
    sources: tuple[Source, ...] | None = None, *, start: Start = Start.AUTO, again: bool = False,
) -> Manifest:
    """Runs a stage whose needs are fresh and returns its manifest; no `sources` are the last ones.

    With `again` it does not continue unfinished work.

    Raises:
        ReconError: as the stage raises it; finished work is kept for the next run.
    """
    workspace = job.workspace
    if sources is None:
        sources = _read_last_sources(job, row) if row.input_metavar else ()
    key = ResultKey(
        row.name, row.version, row.key_options(config), sources, checks.upstream(row),
        verb=row.verb)
    if not row.part:  # else its stage has said so
        _warn_of_stale_uses(checks, row)
    if again:
        workspace.discard(row.name)
    key = dataclasses.replace(key, continues=find_start(workspace, row, key, start))
    inputs = StageInputs(
        {name: workspace.folder(name) for name, digest in key.upstream.items() if digest},
        tuple(Path(source.path) for source in sources),
        workspace.folder(row.name) if key.continues else None,
        {name: digest for name, digest in key.upstream.items() if digest},
        {name: made.run.summary for name in (*row.needs, *row.uses)
         if (made := checks.check(name).manifest)}, _find_earlier(workspace, row), row.part)
    logger.debug("%s: running with %s", row.name, config)
    out, earlier = workspace.begin(key, own_digests=row.own_digests)
    from recon_cli.workspace.records import name_photos  # imports numpy

    rename = name_photos(inputs.folders["ingest"]) if "ingest" in inputs.folders else str
    with machine.Meter() as meter, in_stage(row.name), _discard_if_useless(
            workspace, row, earlier), _naming_photos(rename):
        ctx = stage_context(job, row, limit_rate(lambda done, total: workspace.record(
            dataclasses.replace(earlier, done=done, total=total,
                                seconds=earlier.seconds + meter.seconds))))
        run_it = import_module(row.module).run
        with importing_ahead(job) as while_idle:
            summary: JsonRecord = run_it(
                config, inputs, out,
                dataclasses.replace(ctx, while_idle=while_idle, name_photos=rename))
    outputs = workspace.seal(row.name)
    run = RunRecord(
        seconds=round(earlier.seconds + meter.seconds, 3),
        peak_memory_bytes=meter.peak_memory_bytes, summary=summary.to_json(),
        versions=machine.versions(), device=ctx.device if row.renders else None,
        backend=ctx.backend if row.renders else None, threads=ctx.threads,
        finished=datetime.now().astimezone().isoformat(timespec="seconds"))
    manifest = Manifest(key, outputs, digest_outputs(outputs, row.volatile), run)
    workspace.commit(manifest)
    logger.debug("%s: finished in %.1f s", row.name, run.seconds)
    return manifest


def _find_earlier(workspace: Workspace, row: Stage) -> EarlierResult | None:
    """Returns the result whose edits a stage reads."""
    folder = workspace.folder(row.name)
    try:
        finished = workspace.manifest(row.name)
    except ManifestError:
        return None
    if finished is None or not row.edits:
        return None
    present = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")
               if path.is_symlink() or not path.is_dir()}
    changed = {name for name, path in present.items()
               if (known := finished.outputs.get(name)) is not None
               and (not path.is_file() or digest_file(path, known).sha256 != known.sha256)}
    return EarlierResult(
        folder, frozenset(changed),
        frozenset(finished.outputs.keys() - present.keys()),
        frozenset(present.keys() - finished.outputs.keys() - {MANIFEST}))


@contextmanager
def importing_ahead(job: Job) -> Iterator[Callable[[], None]]:
    """Yields a function that imports, in a thread, the modules of rendering stages: seconds.

    Kernels that are compiled are loaded, too.

    Only for a block whose own thread imports nothing from then on: two threads that import modules
    which need each other may get one of them half made.
    """
    rows = [row for row in job.table if row.renders and row.name in job.asked]
    threads: list[threading.Thread] = []

    def start() -> None:
        if rows:
            import_module("multiprocessing.synchronize")  # which tqdm imports for its first bar
            threads.append(threading.Thread(target=_load_quietly, args=(rows[0], job.compute)))
            threads[-1].start()

    try:
        yield start
    finally:
        for thread in threads:
            thread.join()


def _load_quietly(row: Stage, compute: ComputeConfig) -> None:
    with suppress(Exception):  # of any package; whoever needs it imports it again, and fails then
        import_module(row.module)
        from recon_cli.render import registry

        if (registry.renders_on_cpu(compute.backend, compute.device)
                and not registry.kernels_to_compile("numba")):
            registry.prepare("numba", lambda: None)


@contextmanager
def _naming_photos(rename: Callable[[str], str]) -> Iterator[None]:
    """Names photos in the errors of a stage as its notices do."""
    try:
        yield
    except ReconError as error:
        error.message, error.hint = rename(error.message), rename(error.hint)
        error.args = (error.message,)
        raise


@contextmanager
def _discard_if_useless(workspace: Workspace, row: Stage, earlier: PartialRun) -> Iterator[None]:
    """Discards the unfinished work of a stage that failed where nothing is worth resuming.

    That is before it recorded any, or where it read the user's own files for the first time and
    refused them: the same files would be refused again.
    """
    try:
        yield
    except ReconError as error:
        partial = workspace.partial_run(row.name)
        refused = row.input_metavar and isinstance(error, InputError) and not earlier.total
        if partial and (partial.total == 0 or refused):
            workspace.discard(row.name)
        raise


def _warn_of_stale_uses(checks: WorkspaceCheck, row: Stage) -> None:
    for name in row.uses:
        check = checks.check(name)
        if check.manifest and not check.usable:
            logger.warning("%s is left out of %s: it is %s", name, row.verb, check.describe())


def last_sources(job: Job, stage: str) -> tuple[Source, ...]:
    """Returns the user's files of a stage's previous run as they were then; none if unknown."""
    try:
        latest = job.workspace.partial_run(stage) or job.workspace.manifest(stage)
    except ManifestError:  # whoever needs more than a guess reads the manifest himself
        latest = None
    return latest.key.sources if latest else ()


def _read_last_sources(job: Job, row: Stage) -> tuple[Source, ...]:
    """Returns the sources of the previous run as they are now."""
    sources = last_sources(job, row.name)
    if not sources:
        verb = "run" if len(job.asked) > 1 else row.verb
        raise ConfigError(
            f"{verb} needs an input: none was given, and {job.workspace.root} has no previous one.",
            hint=f"Type {name_command(f'{verb} {row.input_metavar}')}"
            f"{', or a folder of photos in place of VIDEO' * (row.input_metavar == 'VIDEO')}.")
    return tuple(
        read_source(Path(source.path), known=source, without=job.workspace.root)
        for source in sources)


def stage_context(job: Job, row: Stage, record: Callable[[int, int], None]) -> StageContext:
    """Returns the context of a stage, with device and threads set up."""
    if row.renders:
        context = render_context(job.compute, job.progress)
        return dataclasses.replace(
            context, record=record, callbacks=job.callbacks, scratch=job.workspace.partial(""),
            compute=job.compute, deadline=job.deadline, shared=job.shared)
    threads = job.compute.threads or machine.usable_threads()
    return StageContext(
        progress=job.progress, threads=threads, record=record, deadline=job.deadline)


def render_context(compute: ComputeConfig, progress: Progress) -> StageContext:
    """Returns where to train and render, once ready.

    Raises:
        BackendError: the requested backend or device is not available.
    """
    from recon_cli.render import registry  # imports torch

    threads = compute.threads or machine.usable_threads()
    backend, device = registry.resolve(compute.backend, compute.device)
    registry.use_threads(backend, threads)
    _prepare_kernels(progress, backend)
    most = None if compute.max_memory is None else int(compute.max_memory * 1e9)
    return StageContext(progress, device, backend, threads, max_memory_bytes=most)


def light_context(compute: ComputeConfig, progress: Progress) -> StageContext:
    """Returns where to draw a few views: with numba without torch, if that may be and is ready."""
    from recon_cli.render import drawing  # imports numpy

    threads = compute.threads or machine.usable_threads()
    if (compute.backend in ("auto", "numba") and compute.device in ("auto", "cpu")
            and drawing.use_kernels(threads)):
        return StageContext(progress, "cpu", "numba", threads)
    return render_context(compute, progress)


def _prepare_kernels(progress: Progress, backend: str) -> None:
    """Loads the kernels of a backend; shows a bar where they must be compiled first."""
    from recon_cli.render import registry  # imports torch

    count = registry.kernels_to_compile(backend)
    if not count:  # kernels that turn out to be damaged are compiled here too
        registry.prepare(backend, lambda: None)
        return
    with progress.bar("compile for this CPU, once", count, unit="kernel") as bar:
        seconds = registry.prepare(backend, bar.advance)
    logger.info("kernels compiled in %.1f s", seconds)


def refuse_missing_backend(job: Job, stages: Sequence[str]) -> None:
    """Raises BackendError where one of `stages` renders with a named backend that is missing."""
    named = (job.compute.device, job.compute.backend) != ("auto", "auto")
    if named and any(row.renders for row in job.table if row.name in stages):
        from recon_cli.render import registry  # imports torch

        registry.resolve(job.compute.backend, job.compute.device)
