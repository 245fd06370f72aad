"""The status of each stage as the report shows it: state, reasons, the command to type."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from recon_cli.errors import ManifestError, StageError
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import StageCheck, WorkspaceCheck
from recon_cli.stages import Stage
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.summaries import JsonRecord

Record = TypeVar("Record", bound=JsonRecord)


@dataclass(frozen=True)
class StageStatus:
    """The status of one stage."""

    name: str
    folder: Path  # of its result
    state: str  # as in `recon status`; "damaged" if a manifest up to it cannot be trusted
    why: str  # reasons or progress; empty where it is fresh
    command: str  # brings it up to date
    manifest: Manifest | None = None  # None without a result that can be trusted
    gone: tuple[str, ...] = ()  # inputs that no longer exist

    @property
    def fresh(self) -> bool:
        """Whether its figures hold."""
        return self.state == "fresh"

    @property
    def there(self) -> bool:
        """Whether there is a result, fresh or not."""
        return self.manifest is not None

    @property
    def summary(self) -> Mapping[str, Any]:
        """The summary that the stage left in its manifest; empty without a result."""
        return self.manifest.run.summary if self.manifest else {}

    def read_summary(self, kind: type[Record]) -> Record | None:
        """Returns the summary as the stage's record; None without one that can be read."""
        try:
            return kind.from_json(self.summary) if self.manifest else None
        except ManifestError:  # of another version: the stage is stale then, and `why` says so
            return None

    @property
    def stale_suffix(self) -> str:
        """What a label of its figures ends with: nothing where they are fresh."""
        return "" if self.fresh else " (stale)"


Statuses = Mapping[str, StageStatus]  # by the name of the stage


def inspect_stages(job: Job) -> dict[str, StageStatus]:
    """Returns the status of every stage by name.

    Raises:
        StageError: ingest has not run yet.
        ManifestError: the manifest of ingest cannot be trusted.
        ConfigError: the settings hold a value that cannot be used.
    """
    inspection = job.inspect()
    first = inspection.check("ingest")
    if first.manifest is None:
        raise StageError(
            f"The report needs ingest, which is {first.describe()}.",
            hint=f"Run `{_command(inspection, first, job.workspace.root)}` first.")
    return {row.name: _inspect_stage(inspection, row, job) for row in job.table}


def _inspect_stage(inspection: WorkspaceCheck, row: Stage, job: Job) -> StageStatus:
    folder, root = job.workspace.folder(row.name), job.workspace.root
    try:
        check = inspection.check(row.name)
    except ManifestError as error:
        again = f"recon {row.verb} --again -w {shlex.quote(str(root))}"
        return StageStatus(row.name, folder, "damaged", error.message, again)
    why = "; ".join(check.reasons)
    partial = check.partial_run
    if check.state == "partial" and partial:
        why = "; ".join(filter(None, [
            f"a run was interrupted at {partial.done} of {partial.total}", why]))
    return StageStatus(
        row.name, folder, check.state, why, _command(inspection, check, root), check.manifest,
        check.gone)


def _command(inspection: WorkspaceCheck, check: StageCheck, root: Path) -> str:
    """Returns the command with its inputs, if the stage reads any, and the workspace."""
    latest = check.partial_run or check.manifest
    inputs = [source.path for source in latest.key.sources] if latest else []
    return " ".join([
        plan.command(inspection, check), *map(shlex.quote, inputs), "-w", shlex.quote(str(root))])
