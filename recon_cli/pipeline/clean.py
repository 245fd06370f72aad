"""What `recon clean` may remove: by default only what no finished result depends on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.pipeline.execute import Job
from recon_cli.workspace.digests import matches
from recon_cli.workspace.layout import disk_errors, remove, size_of

# Logs are volatile too, but later stages read times from them and they free next to nothing.
_WORTH_BYTES = 1 << 20


@dataclass(frozen=True)
class Freed:
    """Something that is removed, and its size in bytes."""

    path: Path
    size: int


def free_space(job: Job, stages: Sequence[str] = (), *, dry: bool = False) -> tuple[Freed, ...]:
    """Removes what can be spared and returns it.

    Without `stages` that is unfinished work, replaced results, and large volatile files: what is
    fresh stays fresh. With `stages` it is the results of those stages.

    Args:
        job: whose workspace is cleaned.
        stages: names of stages whose results go.
        dry: remove nothing, only tell.

    Raises:
        WorkspaceError: another process holds the workspace, or it cannot be written.
    """
    workspace = job.workspace
    if not workspace.root.exists():
        return ()
    with disk_errors(workspace.root, "cleaning"), workspace.writing("clean"):
        paths = [workspace.folder(stage) for stage in stages] or _spare(job)
        freed = tuple(Freed(path, size_of(path)) for path in paths if path.exists())
        if dry:
            return freed
        for stage in stages:
            workspace.remove(stage)
        for path in () if stages else paths:
            remove(path)
    return freed


def _spare(job: Job) -> list[Path]:
    paths = job.workspace.scraps()
    for row in job.table:
        folder = job.workspace.folder(row.name)
        manifest = job.workspace.manifest(row.name)
        paths += [
            folder / name for name, file in (manifest.outputs if manifest else {}).items()
            if matches(name, row.volatile) and file.size >= _WORTH_BYTES]
    return paths
