"""Whether a training continues the finished scene in the workspace, or begins anew.

It continues a finished run where more steps are asked for and nothing else that decides the
result differs, and an imported scene where that is asked for. The continued scene is part of its
key: the same options give other bytes from another start.
"""

from __future__ import annotations

import dataclasses
import logging
from enum import Enum

from recon_cli.errors import Hint, ManifestError, StageError, name_command
from recon_cli.stages import IMPORT, Stage
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import (
    Manifest,
    PartialRun,
    ResultKey,
    differences,
    find_changed_outputs,
    version_differences,
)

_LENGTH = ("iterations", "minutes")  # options that decide only how long a training is
# The verb `merge`, which put blocks together, is gone; no record of it has a verb. Its version:
_MERGE_VERSION = 2

logger = logging.getLogger("recon")


class Start(Enum):
    """The start of a run: anew, a finished run or an imported scene."""

    AUTO = "auto"  # a finished run that it prolongs, else nothing
    ANEW = "anew"  # nothing
    IMPORTED = "imported"  # the imported scene


def made_by(key: ResultKey) -> str:
    """Returns the verb that made a result; empty where an older record leaves that to the stage.

    Training itself reads no file of the user.
    """
    if key.verb or not key.sources or key.stage != IMPORT.name:
        return key.verb
    return "merge" if key.version == _MERGE_VERSION else IMPORT.verb


def is_imported(key: ResultKey) -> bool:
    """Returns whether a scene was imported."""
    return made_by(key) == IMPORT.verb


def origin_row(row: Stage, key: ResultKey) -> Stage:
    """Returns the row that a result in the place of `row` came from."""
    return IMPORT if is_imported(key) else row


def may_resume(workspace: Workspace, partial: PartialRun) -> bool:
    """Returns whether the result that an interrupted run continues, if any, is still in place."""
    if partial.key.continues is None:
        return True
    try:
        finished = workspace.manifest(partial.key.stage)
    except ManifestError:
        return False
    return finished is not None and finished.digest == partial.key.continues


def find_start(workspace: Workspace, row: Stage, key: ResultKey, start: Start) -> str | None:
    """Returns the digest of the finished result that a run continues; None: it begins anew.

    Raises:
        StageError: no scene was imported to start from, or training anew would replace it.
    """
    if row.name != IMPORT.name or key.sources or start is Start.ANEW:
        return None
    partial = workspace.partial_run(row.name)
    if partial and (start is Start.AUTO or partial.key.continues) and _resumes(
            workspace, partial, key):
        return partial.key.continues
    finished = workspace.manifest(row.name)
    if finished and made_by(finished.key) not in ("", row.verb, IMPORT.verb):
        finished = None
    if finished and is_imported(finished.key):
        return _find_imported(workspace, row, key, finished, start)
    origin = finished.run.summary.get("imported_from") if finished else None
    if start is Start.IMPORTED and not origin:
        raise StageError(
            f"{workspace.root} holds no imported scene to start from.",
            hint=Hint("import", "FILE", then=" first"))
    if finished is None:
        return None
    reasons = _obstacles(workspace, row, key, finished)
    if not reasons:
        return finished.digest
    if origin:
        raise StageError(
            f"{workspace.root} holds the scene imported from {origin}, trained further, which "
            f"would be lost: {'; '.join(reasons)}.",
            hint=f"Run {name_command(f'import {origin} --again')} and "
            f"{name_command('train --from-import')}, or train "
            f"without it by {name_command('train --again')}.")
    if _is_longer(key, finished):
        logger.info("%s begins anew: %s", row.name, "; ".join(reasons))
    return None


def _resumes(workspace: Workspace, partial: PartialRun, key: ResultKey) -> bool:
    """Returns whether an interrupted run is the one of `key`, with any start."""
    same = dataclasses.replace(key, continues=partial.key.continues)
    return may_resume(workspace, partial) and partial.key.fingerprint == same.fingerprint


def _find_imported(
    workspace: Workspace, row: Stage, key: ResultKey, finished: Manifest, start: Start
) -> str:
    """Returns the digest of the imported scene; StageError where training may not start from it."""
    name = finished.run.summary.get("imported_from")
    if start is not Start.IMPORTED:
        raise StageError(
            f"{workspace.root} holds the scene imported from {name}, which `recon {row.verb}` "
            "would replace.",
            hint="Train it further with --from-import, or replace it by --again.")
    reasons = find_changed_outputs(workspace.folder(row.name), finished, row.volatile)
    if any(finished.key.upstream.get(need) != digest for need, digest in key.upstream.items()):
        reasons.append("it has not been compared with the views as they are now")
    if reasons:
        raise StageError(
            f"The scene imported from {name} is stale: {'; '.join(reasons)}.",
            hint=Hint("import", then=" first"))
    return finished.digest


def _obstacles(
    workspace: Workspace, row: Stage, key: ResultKey, finished: Manifest
) -> list[str]:
    """Returns in words why a run of `key` does not prolong a finished one."""
    known = dataclasses.replace(finished.key, config=row.config.rename(finished.key.config))
    keys, late = (_without_length(known), _without_length(key)), row.config.late_fields()
    reasons = version_differences(*keys, section=row.name, late=late)
    reasons += differences(*keys, section=row.name, late=late)
    reasons += find_changed_outputs(
        workspace.folder(row.name), finished, row.volatile, edits=row.edits)
    if finished.run.summary.get("blocks"):
        reasons.append("the finished run was trained in blocks")
    if protocol := key.config.get("protocol"):
        reasons.append(f"a run of the protocol {protocol} starts from the points of sfm")
    if not _is_longer(key, finished):
        reasons.append(f"{row.name}.iterations is not above the "
                       f"{finished.run.summary.get('planned_iterations', 0):,} of the finished run")
    return reasons


def _is_longer(key: ResultKey, finished: Manifest) -> bool:
    steps, before = (
        key.config.get("iterations"), finished.run.summary.get("planned_iterations"))
    return isinstance(steps, int) and isinstance(before, int) and steps > before


def _without_length(key: ResultKey) -> ResultKey:
    return dataclasses.replace(key, config={
        name: value for name, value in key.config.items() if name not in _LENGTH})
