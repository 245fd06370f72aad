"""Decides which stages run, and says how each of them stands.

A target that is fresh is left alone. What it needs is run first where the table allows that
(denoise, sfm, place); otherwise (ingest, train) an error names the command to type.

A target's options are defaults < recon.toml < --config < command line. Every other stage keeps the
options of its result, unless recon.toml, --config or --set say otherwise (see `freshness`).
"""

from __future__ import annotations

import dataclasses
import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.fields import OptionInfo, StageConfig, option_info
from recon_cli.errors import Hint, ReconError, StageError, WorkspaceError, name_command
from recon_cli.pipeline.compile_ahead import compile_ahead
from recon_cli.pipeline.continuation import Start, is_imported, may_resume
from recon_cli.pipeline.execute import Job, Outcome, last_sources, refuse_missing_backend, run_stage
from recon_cli.pipeline.freshness import StageCheck, WorkspaceCheck, warn_of_other_versions
from recon_cli.stages import IMPORT, Stage
from recon_cli.workspace.digests import Source, matches, read_source
from recon_cli.workspace.layout import LOG, disk_errors
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.paths import is_plain_file

__all__ = ["Job", "Outcome", "StageStatus", "Target", "plan", "run", "run_stage", "status"]

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Target:
    """A stage that the user asked for, its options, and its files; none for the previous ones."""

    stage: str
    config: StageConfig
    sources: tuple[Path, ...] = ()
    start: Start = Start.AUTO


@dataclass(frozen=True)
class StageStatus:
    """How a stage stands; `recon status --json` prints these fields under these names."""

    name: str  # of the stage and of its folder
    # fresh, stale, partial, missing, damaged, or made by another version: older or newer
    state: str
    reasons: tuple[str, ...]  # why it is not fresh, in words
    done: int  # how much of an interrupted run would be resumed; 0 where there is none
    total: int  # of how much; 0 without an interrupted run
    seconds: float | None  # that the finished result took; None where there is none
    summary: dict[str, Any]  # of the finished result
    notices: tuple[str, ...]  # for the user; they make nothing stale


def status(job: Job) -> tuple[StageStatus, ...]:
    """Returns how every stage stands. Takes no lock and changes nothing.

    A stage whose manifest cannot be trusted is damaged; stages that need it are stale.

    Raises:
        ConfigError: the settings hold a value that cannot be used.
    """
    checks = WorkspaceCheck(job.workspace, job.settings, job.table, tolerant=True)
    with disk_errors(job.workspace.root, "reading the workspace"):
        return tuple(
            _status(check) for row in job.table
            for check in (checks.check(row.name), *check_parts(job, row.name)))


def _status(check: StageCheck) -> StageStatus:
    run, partial = check.manifest and check.manifest.run, check.partial_run
    return StageStatus(
        check.row.name, check.state, (*check.reasons, *check.version_reasons),
        partial.done if partial else 0,
        partial.total if partial else 0,
        run.seconds if run else None,
        dict(run.summary) if run else {},
        (*(run.summary.get("notices", ()) if run else ()),
         *(f"the input {path} is gone" for path in check.gone)))


def run(
    job: Job, verb: str, targets: Sequence[Target], *, again: bool = False
) -> tuple[Outcome, ...]:
    """Brings every target up to date, in order, and returns the outcome of each.

    Fresh targets run only with `again`, which also discards their unfinished work. `verb` is shown
    to processes that want the workspace.

    Raises:
        StageError: a need is not fresh and not automatic, or another verb's scene would be
            replaced.
        WorkspaceError: the workspace is in use, full, or not writable.
        ReconError: as the stages raise it.
    """
    outcomes = []
    root, stages = job.workspace.root, [target.stage for target in targets]
    with disk_errors(root, f"running {verb}"), job.workspace.writing(verb), _log_to(root / LOG):
        refuse_missing_backend(job, stages)
        if not again:
            refuse_to_replace(job, verb, [
                target.stage for target in targets if target.start is not Start.IMPORTED])
        with compile_ahead(job, stages, again=again):
            job = dataclasses.replace(job, asked=tuple(stages))
            for target in targets:
                for outcome in _bring_up_to_date(job, target, again=again):
                    job.report(outcome)
                    outcomes.append(outcome)
                outcomes += _make_parts(job, target, again=again)
    return tuple(outcomes)


def _make_parts(job: Job, target: Target, *, again: bool) -> list[Outcome]:
    """Brings the parts of a target up to date that are asked for, and names others that are stale.

    One that fails takes nothing from the others; its error is raised at the end.
    """
    outcomes: list[Outcome] = []
    errors: list[ReconError] = []
    for part in target.config.parts:
        own = dataclasses.replace(target, stage=f"{target.stage}.{part}")
        try:
            for outcome in _bring_up_to_date(job, own, again=again):
                job.report(outcome)
                outcomes.append(outcome)
        except WorkspaceError:
            raise
        except ReconError as error:
            if target.config.excuses(error):
                logger.warning("%s was not written: %s %s", own.stage, error.message, error.hint)
            else:
                errors.append(error)
    for check in check_parts(job, target.stage):
        if check.manifest and not check.fresh and check.row.part not in target.config.parts:
            logger.warning("%s is %s. It is kept; --format %s writes it again.",
                           check.manifest.run.summary["file"], check.describe(), check.row.part)
    if errors:
        raise _join_errors(errors, outcomes)
    return outcomes


def _join_errors(errors: Sequence[ReconError], outcomes: Sequence[Outcome]) -> ReconError:
    """Returns the first error, with what the others say and what was written nevertheless."""
    error, files = errors[0], [str(one.manifest.run.summary["file"]) for one in outcomes]
    message = " ".join(dict.fromkeys(one.message for one in errors))
    error.message = f"{message} Written: {', '.join(files)}." if files else message
    error.hint = " ".join(dict.fromkeys(one.hint for one in errors if one.hint))
    error.args = (error.message,)
    return error


def check_parts(job: Job, stage: str) -> tuple[StageCheck, ...]:
    """Returns how the parts of a stage stand that are there, or were begun."""
    checks = WorkspaceCheck(job.workspace, job.settings, job.table, tolerant=True)
    found = (checks.check(part.name) for part in checks.row(stage).parts)
    return tuple(check for check in found if check.state != "missing")


def refuse_to_replace(job: Job, verb: str, stages: Sequence[str]) -> None:
    """Raises StageError where training or import would replace the scene of the other."""
    for row in [row for row in job.table if row.name == IMPORT.name and row.name in stages]:
        finished, partial = job.workspace.manifest(row.name), job.workspace.partial_run(row.name)
        importing = row.verb == IMPORT.verb
        if finished and is_imported(finished.key) is not importing:
            if partial and partial.key.continues and may_resume(job.workspace, partial):
                continue  # it is trained further already
            sources = finished.key.sources
            scene = (f"the scene imported from {Path(sources[0].path).name}" if sources
                     else "a scene that was trained")
        elif importing and partial and partial.done and not is_imported(partial.key):
            scene = f"a training that was interrupted at {partial.done} of {partial.total}"
        else:
            continue
        further = "" if importing else (
            f", train it further by {name_command('train --from-import')}")
        raise StageError(
            f"{job.workspace.root} holds {scene}, which `recon {verb}` would replace.",
            hint=f"Give another workspace with -w{further}, or replace it by "
            f"{name_command(f'{verb} --again')}.")


def plan(checks: WorkspaceCheck, stage: str) -> tuple[Stage, ...]:
    """Returns the stages that must run before `stage` can, in order.

    Raises:
        StageError: one of them is never run implicitly; the hint is the command to type.
    """
    steps: list[Stage] = []
    target = checks.row(stage)

    def visit(name: str) -> None:
        check = checks.check(name)
        if check.fresh or (check.usable and target.reads_other_versions) or check.row in steps:
            return
        if not check.row.auto:
            raise _need_error(checks, check, target.verb)
        for need in check.row.needs:
            visit(need)
        steps.append(check.row)

    for need in target.needs:
        visit(need)
    return tuple(steps)


def require(
    checks: WorkspaceCheck, stages: Sequence[str], reader: str, *, fresh: bool = False
) -> dict[str, Manifest]:
    """Returns the manifests of results that `reader` needs, with a notice of other versions.

    Those of another version of recon are only for readers that do not train: not with `fresh`.
    StageError if one is missing or stale.
    """
    found = {name: checks.check(name) for name in stages}
    for check in found.values():
        if not check.fresh and (fresh or not check.usable):
            raise _need_error(checks, check, reader)
    warn_of_other_versions(found.values(), reader)
    return {name: check.manifest for name, check in found.items() if check.manifest}


def _need_error(checks: WorkspaceCheck, check: StageCheck, reader: str) -> StageError:
    """Returns the error of a result that `reader` cannot take; its hint costs no training."""
    scene = checks.finished_scene
    hint = str(Hint(command(checks, check), then=" first"))
    if scene and check.usable:
        hint = (f"The scene in {scene} can be viewed, rendered, scored and exported as it is. "
                "To train with this version of recon, read the capture into another workspace "
                "with -w.")
    elif scene:
        hint += f" The scene of before stays in {scene} until it is trained anew."
    if check.state == "newer":
        hint = "Update recon: a newer version made this workspace."
    return StageError(f"{reader} needs {check.row.name}, which is {check.describe()}.", hint=hint)


def command(checks: WorkspaceCheck, check: StageCheck) -> str:
    """Returns the command, without `recon`, that updates a stage with the options it had."""
    words = [check.row.verb]
    keys = [latest.key for one in (check, *checks.siblings(check.row))
            if (latest := one.partial_run or one.manifest)]
    if not keys:
        return " ".join([*words, check.row.input_metavar] if check.row.input_metavar else words)
    key = dataclasses.replace(keys[0], config={
        name: value for each in keys for name, value in each.config.items()})
    config, default = checks.config(check.row, key), checks.config(check.row, None)
    for item in dataclasses.fields(check.row.config):
        value, info = getattr(config, item.name), option_info(item)
        if value not in (None, getattr(default, item.name)) and info.hashed:
            words += _option_words(item.name, value, info)
    return shlex.join(words)


def _option_words(name: str, value: Any, info: OptionInfo) -> list[str]:
    """Returns the words that give an option a value."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    if info.flags:  # the choices are options themselves: --force
        return [f"--{value}"]
    return [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]


def _bring_up_to_date(job: Job, target: Target, *, again: bool) -> Iterator[Outcome]:
    """Runs the needs of a target and then the target, and yields every stage that is done."""
    checks = job.inspect()
    row = checks.row(target.stage)
    sources = _read_sources(job, target)
    fresh = None if again else _find_fresh(job, checks, target, sources)
    steps = () if fresh else plan(checks, row.name)
    for step in steps:
        yield from _run_if_needed(job, step)
    if steps:
        checks = job.inspect()
        plan(checks, row.name)  # a fresh stage may have become stale by the last one
        fresh = None if again else _find_fresh(job, checks, target, sources)
    if not row.part:  # else its stage has said so
        warn_of_other_versions(map(checks.check, row.needs), row.verb)
    if fresh is None:
        _require_states(job, checks, row)
        start = Start.ANEW if again and target.start is Start.AUTO else target.start
        manifest = run_stage(job, checks, row, target.config, sources, start=start, again=again)
        yield Outcome(row.name, manifest, ran=True)
    else:
        yield Outcome(row.name, fresh, ran=False)


def _require_states(job: Job, checks: WorkspaceCheck, row: Stage) -> None:
    """Raises StageError where a stage starts from a state that `recon clean` removed."""
    for check in map(checks.check, row.from_states):
        for name in check.manifest.outputs if check.manifest else ():
            if matches(name, check.row.states) and not (
                    job.workspace.folder(check.row.name) / name).exists():
                raise StageError(
                    f"{row.verb} starts from {check.row.name}/{name}, which was removed.",
                    hint=Hint(command(checks, check), again=True, then=" first"))


def _run_if_needed(job: Job, row: Stage) -> Iterator[Outcome]:
    """Runs a stage that a target needs, with the options it had, unless it is fresh by now."""
    checks = job.inspect()
    check = checks.check(row.name)
    if not check.fresh:
        logger.info("%s is %s: it runs first", row.name, check.describe())
        config = checks.config(row, check.manifest.key if check.manifest else None)
        yield Outcome(row.name, run_stage(job, checks, row, config), ran=True)


def _read_sources(job: Job, target: Target) -> tuple[Source, ...] | None:
    """Returns the files given with a target as they are now; None for the previous ones."""
    if not target.sources:
        return None
    known = {source.path: source for source in last_sources(job, target.stage)}
    return tuple(
        read_source(path, known=known.get(str(path.absolute())), without=job.workspace.root)
        for path in target.sources)


def _find_fresh(
    job: Job, checks: WorkspaceCheck, target: Target, sources: tuple[Source, ...] | None
) -> Manifest | None:
    """Returns the result of a target if it is fresh; records where an input was moved to."""
    check = checks.check_against(target.stage, target.config, sources)
    manifest = check.manifest
    if manifest is None or not check.fresh:
        if manifest:
            logger.info("%s is %s", target.stage, check.describe())
        return None
    if sources and sources != manifest.key.sources:
        key = dataclasses.replace(manifest.key, sources=sources)
        manifest = dataclasses.replace(manifest, key=key)
        manifest.write(job.workspace.folder(target.stage))
    return manifest


class _LogFile(logging.FileHandler):
    """The log in the workspace: where the disk is full, lines are lost without a message."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  # logging's name
        """Ignores a failure to write: files that matter report their own."""
        if not isinstance(sys.exception(), OSError):
            super().handleError(record)

    def close(self) -> None:
        """Closes the file; the rest of the buffer may not fit."""
        with suppress(OSError):
            super().close()


@contextmanager
def _log_to(path: Path) -> Iterator[None]:
    """Writes everything that is logged, failures with their traceback, to a file as well."""
    if os.path.lexists(path) and not is_plain_file(path):
        logger.warning("%s is not a plain file: this run is not logged", path)
        yield
        return
    # File names need not be UTF-8, and a message that names one must not be lost for it.
    handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    try:
        yield
    except BaseException:
        # To the file alone: the caller decides on the terminal.
        handler.handle(logger.makeRecord(
            logger.name, logging.ERROR, __file__, 0, "failed", (), sys.exc_info()))
        raise
    finally:
        logger.removeHandler(handler)
        handler.close()
