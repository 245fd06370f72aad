"""How each stage stands, in the words of the page."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from recon_cli.errors import ManifestError, StageError
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import Check, Inspection
from recon_cli.stages import Stage
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.summaries import JsonRecord

DAMAGED = "damaged"

S = TypeVar("S", bound=JsonRecord)


@dataclass(frozen=True)
class Standing:
    """One stage.

    Attributes:
        name: of the stage.
        folder: of its result.
        state: fresh, stale, partial or missing as in `recon status`; or damaged, where its manifest
            or one before it cannot be trusted.
        why: reasons or progress, in words; empty where it is fresh.
        command: what to type to bring it up to date.
        manifest: of its result; None where there is none that can be trusted.
        gone: inputs that are no longer there.
    """

    name: str
    folder: Path
    state: str
    why: str
    command: str
    manifest: Manifest | None = None
    gone: tuple[str, ...] = ()

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
        """What the stage said about its result; empty without one."""
        return self.manifest.run.summary if self.manifest else {}

    def read_summary(self, kind: type[S]) -> S | None:
        """Returns the stage's record; None without one that this version can read."""
        try:
            return kind.from_json(self.manifest.run.summary) if self.manifest else None
        except ManifestError:  # the stage is stale then, and `why` says so
            return None


def standings(job: Job) -> dict[str, Standing]:
    """Returns how every stage stands, by name.

    Raises:
        StageError: nothing was read in yet.
        ManifestError: the manifest of ingest cannot be trusted.
        ConfigError: the settings hold a value that cannot be used.
    """
    look = job.inspect()
    first = look.check("ingest")
    if first.manifest is None:
        raise StageError(
            f"The report needs ingest, which is {first.described()}.",
            hint=f"Run `{_command(look, first, job.workspace.root)}` first.")
    return {row.name: _standing(look, row, job) for row in job.table}


def _standing(look: Inspection, row: Stage, job: Job) -> Standing:
    folder, root = job.workspace.folder(row.name), job.workspace.root
    try:
        check = look.check(row.name)
    except ManifestError as error:
        again = f"recon {row.verb} --again -w {shlex.quote(str(root))}"
        return Standing(row.name, folder, DAMAGED, error.message, again)
    why = "; ".join(check.reasons)
    if check.state == "partial" and check.unfinished:
        why = "; ".join(filter(None, [
            f"a run was interrupted at {check.unfinished.done} of {check.unfinished.total}", why]))
    return Standing(
        row.name, folder, check.state, why, _command(look, check, root), check.manifest, check.gone)


def _command(look: Inspection, check: Check, root: Path) -> str:
    """Returns what to type, with the inputs where the stage reads any, and the workspace."""
    words = plan.command(look, check)
    latest = check.unfinished or check.manifest
    inputs = [source.path for source in latest.basis.sources] if latest else []
    return " ".join([words, *map(shlex.quote, inputs), "-w", shlex.quote(str(root))])
