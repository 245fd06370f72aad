"""Decides which stages run, and tells how each of them stands.

A verb names its targets. A target that is fresh is left alone. What it needs is run first where the
table allows that (denoise, sfm); where it does not (ingest, train), the user is told what to type.

Where options come from: a target takes defaults < recon.toml < --config < command line, so that a
verb does the same whatever was typed before it. Every other stage keeps the options that its result
was made with, unless recon.toml, --config or --set say otherwise (see `freshness`).
"""

from __future__ import annotations

import dataclasses
import logging
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.fields import OptionInfo, StageConfig, option_info
from recon_cli.errors import StageError
from recon_cli.pipeline.execute import Job, Outcome, last_sources, refuse_missing_backend, run_stage
from recon_cli.pipeline.freshness import Check, Inspection, is_imported
from recon_cli.stages import IMPORT, Stage
from recon_cli.workspace.digests import Source, read_source
from recon_cli.workspace.layout import LOG, disk_errors
from recon_cli.workspace.manifest import Manifest, how_far

__all__ = ["Job", "Outcome", "StageStatus", "Target", "plan", "run", "run_stage", "status"]

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Target:
    """A stage that the user asked for.

    Attributes:
        stage: its name.
        config: its options.
        sources: the user's files, for what takes some; empty means those of the last time.
    """

    stage: str
    config: StageConfig
    sources: tuple[Path, ...] = ()


@dataclass(frozen=True)
class StageStatus:
    """How a stage stands; `recon status --json` prints these fields under these names.

    Attributes:
        name: of the stage and of its folder.
        state: fresh, stale, partial or missing.
        reasons: why it is stale, in words.
        done: how much of an interrupted run would be resumed; 0 where there is none.
        total: of how much; 0 where there is no interrupted run.
        seconds: that the finished result took; None where there is none.
        summary: what the stage says about its finished result.
        notices: what should be known but makes nothing stale.
    """

    name: str
    state: str
    reasons: tuple[str, ...]
    done: int
    total: int
    seconds: float | None
    summary: dict[str, Any]
    notices: tuple[str, ...]

    @property
    def how_far(self) -> str:
        """How far an interrupted run came, in a few words."""
        return how_far(self.done, self.total)


def status(job: Job) -> tuple[StageStatus, ...]:
    """Returns how every stage stands. Takes no lock and changes nothing.

    Raises:
        ManifestError: a manifest cannot be trusted.
        ConfigError: the settings hold a value that cannot be used.
    """
    look = job.inspect()
    with disk_errors(job.workspace.root, "reading the workspace"):
        return tuple(_status(look.check(row.name)) for row in job.table)


def _status(check: Check) -> StageStatus:
    run, unfinished = check.manifest and check.manifest.run, check.unfinished
    return StageStatus(
        check.row.name, check.state, check.reasons,
        unfinished.done if unfinished else 0,
        unfinished.total if unfinished else 0,
        run.seconds if run else None,
        dict(run.summary) if run else {},
        (*(run.summary.get("notices", ()) if run else ()),
         *(f"the input {path} is gone" for path in check.gone)),
    )


def run(
    job: Job, verb: str, targets: Sequence[Target], *, again: bool = False
) -> tuple[Outcome, ...]:
    """Brings every target up to date, in order, and returns what was done for each.

    Args:
        job: where and how.
        verb: what the user typed; others who want the workspace are told.
        targets: stages in the order of the table.
        again: run the targets even if they are fresh.

    Raises:
        StageError: something that a target needs is missing or stale and is not made implicitly, or
            a scene would be lost that another verb left.
        WorkspaceError: the workspace is in use, full, or not writable.
        ReconError: whatever the stages raise.
    """
    outcomes = []
    root = job.workspace.root
    with disk_errors(root, f"running {verb}"), job.workspace.writing(verb), _logged(root / LOG):
        refuse_missing_backend(job, [target.stage for target in targets])
        if not again:
            _refuse_to_replace(job, verb, [target.stage for target in targets])
        for target in targets:
            for outcome in _reach(job, target, again=again):
                job.report(outcome)
                outcomes.append(outcome)
    return tuple(outcomes)


def _refuse_to_replace(job: Job, verb: str, stages: Sequence[str]) -> None:
    """Raises StageError where training would take the place of an imported scene, or otherwise.

    A training takes long, and of an imported scene there may be no other copy.
    """
    rows = [row for row in job.table if row.name == IMPORT.name and row.name in stages]
    for row in rows:
        finished, begun = job.workspace.manifest(row.name), job.workspace.unfinished(row.name)
        importing = row.verb == IMPORT.verb
        if finished and is_imported(finished.basis) is not importing:
            name = Path(finished.basis.sources[0].path).name if finished.basis.sources else ""
            what = f"the scene imported from {name}" if name else "a scene that was trained"
        elif importing and begun and begun.done and not is_imported(begun.basis):
            what = f"a training that was interrupted at {begun.done} of {begun.total}"
        else:
            continue
        raise StageError(
            f"{job.workspace.root} holds {what}, which `recon {verb}` would replace.",
            hint=f"Give another workspace with -w, or replace it by `recon {verb} --again`.")


def plan(look: Inspection, stage: str) -> tuple[Stage, ...]:
    """Returns the stages that must run before `stage` can, in order.

    Raises:
        StageError: one of them is never run implicitly; the hint is the command to type.
    """
    steps: list[Stage] = []

    def visit(name: str) -> None:
        check = look.check(name)
        if check.fresh or check.row in steps:
            return
        if not check.row.auto:
            raise StageError(
                f"{look.row(stage).verb} needs {name}, which is {check.described()}.",
                hint=f"Run `{command(look, check)}` first.")
        for need in check.row.needs:
            visit(need)
        steps.append(check.row)

    for need in look.row(stage).needs:
        visit(need)
    return tuple(steps)


def require_fresh(job: Job, stages: Sequence[str]) -> None:
    """Raises StageError unless the results of these stages are there and fresh."""
    look = job.inspect()
    for check in map(look.check, stages):
        if not check.fresh:
            raise StageError(
                f"The {check.row.name} of {job.workspace.root} is {check.described()}.",
                hint=f"Run `{command(look, check)} -w {job.workspace.root}` first.")


def command(look: Inspection, check: Check) -> str:
    """Returns what to type to bring a stage up to date with the options it had."""
    words = ["recon", check.row.verb]
    latest = check.unfinished or check.manifest
    if latest is None:
        return " ".join([*words, check.row.takes] if check.row.takes else words)
    had, plain = look.config(check.row, latest.basis), look.config(check.row, None)
    for item in dataclasses.fields(check.row.config):
        value, info = getattr(had, item.name), option_info(item)
        if value not in (None, getattr(plain, item.name)) and info.hashed:
            words += _typed(item.name, value, info)
    return shlex.join(words)


def _typed(name: str, value: Any, info: OptionInfo) -> list[str]:
    """Returns the words that give an option a value."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    if info.flags:  # the choices are options themselves: --force
        return [f"--{value}"]
    return [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]


def _reach(job: Job, target: Target, *, again: bool) -> Iterator[Outcome]:
    """Runs what a target needs and then the target, and yields every stage that is done."""
    look = job.inspect()
    row = look.row(target.stage)
    sources = _read_sources(job, target)
    fresh = None if again else _if_fresh(job, look, target, sources)
    steps = () if fresh else plan(look, row.name)
    for step in steps:
        yield from _run_if_needed(job, step)
    if steps:
        look = job.inspect()
        plan(look, row.name)  # what was fresh may have become stale by what has just run
        fresh = None if again else _if_fresh(job, look, target, sources)
    if fresh is None:
        yield Outcome(row.name, run_stage(job, look, row, target.config, sources), ran=True)
    else:
        yield Outcome(row.name, fresh, ran=False)


def _run_if_needed(job: Job, row: Stage) -> Iterator[Outcome]:
    """Runs a stage that nobody asked for, with the options it had, unless it is fresh by now."""
    look = job.inspect()
    check = look.check(row.name)
    if not check.fresh:
        logger.info("%s is %s: it runs first", row.name, check.described())
        config = look.config(row, check.manifest.basis if check.manifest else None)
        yield Outcome(row.name, run_stage(job, look, row, config), ran=True)


def _read_sources(job: Job, target: Target) -> tuple[Source, ...] | None:
    """Returns what the files given with a target hold; None means those of the last time."""
    if not target.sources:
        return None
    known = {source.path: source for source in last_sources(job, target.stage)}
    return tuple(
        read_source(path, known=known.get(str(path.absolute())), without=job.workspace.root)
        for path in target.sources)


def _if_fresh(
    job: Job, look: Inspection, target: Target, sources: tuple[Source, ...] | None
) -> Manifest | None:
    """Returns the result of a target if it is fresh; a moved input is remembered where it is."""
    check = look.check_against(target.stage, target.config, sources)
    if check.manifest is None or not check.fresh:
        if check.manifest:
            logger.info("%s is stale: %s", target.stage, "; ".join(check.reasons))
        return None
    recorded = check.manifest
    if sources and sources != recorded.basis.sources:
        recorded = dataclasses.replace(
            recorded, basis=dataclasses.replace(recorded.basis, sources=sources))
        recorded.write(job.workspace.folder(target.stage))
    return recorded


@contextmanager
def _logged(path: Path) -> Iterator[None]:
    """Keeps everything that is logged, failures with their traceback, in a file as well."""
    # File names need not be UTF-8, and a message that names one must not be lost for it.
    handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    try:
        yield
    except BaseException:
        # To the file alone: what the user sees of it is up to the caller.
        handler.handle(logger.makeRecord(
            logger.name, logging.ERROR, __file__, 0, "failed", (), sys.exc_info()))
        raise
    finally:
        logger.removeHandler(handler)
        handler.close()
