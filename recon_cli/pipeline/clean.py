"""Frees disk space: what no finished result needs, and results that are named."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import Hint, ManifestError, StageError
from recon_cli.pipeline.execute import Job
from recon_cli.stages import Stage
from recon_cli.workspace.digests import matches
from recon_cli.workspace.layout import disk_errors, has_link, hold_lock, remove, size_of

# Logs are volatile too, but later stages read times from them and they free next to nothing.
_WORTH_BYTES = 1 << 20
_EXPORT = "export"

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class CleanItem:
    """Something that is removed, and its size in bytes."""

    path: Path
    size: int
    is_link: bool  # which alone is removed, not its target
    stage: str  # that made it; empty for scratch files


def free_space(
    job: Job, stages: Sequence[str] = (), *, states: bool = False, renders: bool = False,
    keep_exports: bool = False, dry: bool = False,
    show: Callable[[Sequence[CleanItem]], None] = lambda _removals: None,
) -> tuple[CleanItem, ...]:
    """Removes dispensable files and returns them, after `show`; with `dry` nothing is removed.

    That is unfinished work, replaced results and large volatile files; with `states` also those
    that only continue a stage, with `renders` the frames of `recon render`; with `keep_exports` all
    results but the exported files. Where `stages` are named it is their results alone. Nothing is
    removed through a link.

    Raises:
        StageError: exports are to be kept, but there is none.
        WorkspaceError: another process holds the workspace, or it cannot be written.
    """
    workspace = job.workspace
    if not workspace.root.exists():
        return ()
    with disk_errors(workspace.root, "cleaning"), workspace.writing("clean"):
        if keep_exports:
            stages = _all_but_exports(job)
        results = [path for stage in stages for path in workspace.result_paths(stage)]
        frames = workspace.renders() if renders else []
        others = [] if stages and not keep_exports else [
            path for path in (*_spare(job, states=states), *frames)
            if not any(path.is_relative_to(result) for result in results)]
        removals = tuple(
            CleanItem(path, size_of(path), path.is_symlink(), _stage_of(job, path))
            for path in (*others, *results) if os.path.lexists(path))
        show(removals)
        if dry:
            return removals
        for stage in stages:
            workspace.remove(stage)
        for path in others:
            if path in frames:  # it has a lock of its own
                with hold_lock(path, "clean", other="no --renders"):
                    pass
            remove(path)
    return removals


def find_states(job: Job) -> list[Path]:
    """Returns the files that only continue a finished stage: states of a training."""
    return [path for row in job.table for path in _outputs(job, row, row.states)]


def _all_but_exports(job: Job) -> list[str]:
    if job.workspace.manifest(_EXPORT) is None:
        raise StageError(
            f"{job.workspace.root} holds no exported scene to keep.",
            hint=Hint("export", then=" first, or name the stages to remove"))
    return [row.name for row in job.table if row.name != _EXPORT]


def _stage_of(job: Job, path: Path) -> str:
    """Returns the stage whose result or unfinished work a path is of; empty for others."""
    names = {row.name for row in job.table}
    parts = path.relative_to(job.workspace.root).parts
    return next((part.split(".")[0] for part in parts if part.split(".")[0] in names), "")


def _spare(job: Job, *, states: bool) -> list[Path]:
    paths = job.workspace.scraps()
    for row in job.table:
        paths += _outputs(job, row, row.volatile, tell=True)
    return [*paths, *(find_states(job) if states else ())]


def _outputs(
    job: Job, row: Stage, patterns: Sequence[str], *, tell: bool = False
) -> Iterator[Path]:
    """Yields the large outputs of a finished stage with these names, but not behind links."""
    folder = job.workspace.folder(row.name)
    try:
        manifest = job.workspace.manifest(row.name)
    except ManifestError as error:
        if tell:
            logger.warning("%s is left as it is: %s %s", row.name, error.message, error.hint)
        return
    # an export tells a scene that was trained further from one that was imported by its states
    if manifest is None or (patterns is row.states and manifest.run.summary.get("imported_from")):
        return
    for name, file in manifest.outputs.items():
        path = folder / name
        if (matches(name, patterns) and file.size >= _WORTH_BYTES and path.is_file()
                and not has_link(path, job.workspace.root)):
            yield path
