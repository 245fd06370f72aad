"""Reconstructs many captures, each in a workspace of its own, and continues after failures."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import ConfigError, ReconError
from recon_cli.jobs.executor import Command, Executor
from recon_cli.jobs.shared_jobs import JobEnd, SharedJob, run_jobs
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job, last_sources
from recon_cli.progress import Progress
from recon_cli.stages import STAGES
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.layout import Workspace, disk_errors
from recon_cli.workspace.manifest import describe_progress
from recon_cli.workspace.summaries import JsonRecord

FILE = "batch.json"
_VERSION = 1
# Percent of a run by its end, on the demo's room
_DONE_AFTER = {"ingest": 4, "denoise": 6, "sfm": 30, "place": 32, "train": 76, "prune": 96,
               "evaluate": 99, "export": 100}


@dataclass(frozen=True)
class Capture:
    """An input, and where its scene goes."""

    name: str
    source: Path  # absolute
    workspace: Path

    @property
    def log(self) -> Path:
        """The output of its command."""
        return self.workspace.with_suffix(f"{self.workspace.suffix}.log")


@dataclass(frozen=True, kw_only=True)
class CaptureResult(JsonRecord):
    """How a capture ended; None for steps that it did not reach."""

    capture: str
    source: str
    exit_code: int | None  # None while it has not ended
    reason: str = ""  # why it failed
    frames: int | None = None
    registered: int | None = None  # frames with a camera
    psnr_db: float | None = None  # of the exported model on the held-out views
    ssim: float | None = None
    gaussians: int | None = None
    bytes: int | None = None  # of the .ply
    seconds: float | None = None  # of all stages, in this call or before

    @property
    def succeeded(self) -> bool:
        """Whether there is a scene."""
        return self.exit_code == 0


def name_captures(inputs: Sequence[Path], out: Path) -> tuple[Capture, ...]:
    """Returns the captures in the order of their inputs, each with a folder below `out`.

    They are named after the files; where two have the same name, with their folder before it.

    Raises:
        ConfigError: an input is given twice, or two have the same name still.
    """
    paths = [path.absolute() for path in inputs]
    twice = [str(path) for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise ConfigError(f"{twice[0]} is given more than once.", hint="Give every input once.")
    # Room and room are one folder on macOS and Windows
    stems = Counter(_stem(path).casefold() for path in paths)
    names = [_stem(path) if stems[_stem(path).casefold()] == 1 else
             f"{path.parent.name}-{_stem(path)}" for path in paths]
    for name, count in Counter(name.casefold() for name in names).items():
        if count > 1:
            same = [str(path) for path, other in zip(paths, names, strict=True)
                    if other.casefold() == name]
            raise ConfigError(
                f"{' and '.join(same)} would both be reconstructed in "
                f"{out / names[paths.index(Path(same[0]))]}.",
                hint="Rename one of them, or give them to batches with different --out.")
    return tuple(
        Capture(name, path, out.absolute() / name)
        for name, path in zip(names, paths, strict=True))


def _stem(path: Path) -> str:
    return path.name if path.is_dir() else path.stem


def run_batch(
    captures: Sequence[Capture], out: Path, words: Sequence[str], executor: Executor,
    progress: Progress, report: Callable[[CaptureResult], None],
) -> tuple[CaptureResult, ...]:
    """Runs `recon run` on every capture and returns how they ended, in their order.

    `words` are options of `recon run`; `report` gets each result when it is there. Results so far
    are in batch.json at any time.

    Raises:
        ConfigError: a workspace holds another capture.
        BackendError: the machines cannot be reached any more.
        KeyboardInterrupt: after the commands have saved their work.
    """
    for capture in captures:
        _refuse_other_capture(capture)
    results = {capture.name: _read_result(capture, None, "") for capture in captures}
    by_name = {capture.name: capture for capture in captures}

    def note(job: SharedJob, end: JobEnd) -> None:
        results[job.name] = _read_result(by_name[job.name], end.code, end.reason)
        _write(out, results.values())
        report(results[job.name])

    _write(out, results.values())
    run_jobs([_job(capture, words) for capture in captures], executor, progress, report=note)
    return tuple(results.values())


def _job(capture: Capture, words: Sequence[str]) -> SharedJob:
    command = Command(
        ("run", str(capture.source), "-w", str(capture.workspace), *words), capture.workspace,
        capture.log)
    return SharedJob(capture.name, command, lambda: _look(Workspace(capture.workspace)))


def _refuse_other_capture(capture: Capture) -> None:
    """Raises ConfigError where the workspace holds a scene of something else."""
    before = last_sources(Job(Workspace(capture.workspace)), STAGES[0].name)
    if before and [source.path for source in before] != [str(capture.source)]:
        raise ConfigError(
            f"{capture.workspace} holds a scene of {before[0].path}, not of {capture.source}.",
            hint="Give another folder with --out, or move that one.")


def _look(workspace: Workspace) -> tuple[float, str]:
    """Returns the share of a run that is done, and its current activity."""
    before = 0
    for row in STAGES:
        after = _DONE_AFTER[row.name]
        partial = workspace.partial_run(row.name)
        if partial:
            share = partial.done / partial.total if partial.total else 0.0
            progress = describe_progress(partial.done, partial.total) if partial.total else ""
            return (before + share * (after - before)) / 100, f"{row.name} {progress}".rstrip()
        if workspace.folder(row.name).exists():
            before = after
    return before / 100, ""


def _read_result(capture: Capture, code: int | None, reason: str) -> CaptureResult:
    """Returns how a capture stands, with the figures of its fresh stages."""
    result = CaptureResult(
        capture=capture.name, source=str(capture.source), exit_code=code, reason=reason)
    try:
        stages = plan.status(Job(Workspace(capture.workspace)))
    except ReconError:  # a damaged manifest, of which the command has told
        return result
    fresh = {stage.name: stage.summary for stage in stages if stage.state == "fresh"}
    export = fresh.get("export", {})
    scores = {key.removeprefix(f"{export.get('model')}_"): value
              for key, value in fresh.get("evaluate", {}).items()}
    return dataclasses.replace(
        result, frames=fresh.get("ingest", {}).get("frames"),
        registered=fresh.get("place", {}).get("registered"), psnr_db=scores.get("psnr_db"),
        ssim=scores.get("ssim"), gaussians=export.get("gaussians"), bytes=export.get("bytes"),
        seconds=round(sum(stage.seconds or 0.0 for stage in stages if stage.name in fresh), 1))


def _write(out: Path, results: Iterable[CaptureResult]) -> None:
    """Writes batch.json atomically."""
    with disk_errors(out, "writing the results"):
        write_json(out / FILE, {
            "version": _VERSION, "captures": [result.to_json() for result in results]})
