"""The stages as the report shows them: status, command to type, options, decisions, versions."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import psutil

from recon_cli import __version__, machine
from recon_cli.errors import FormatError, ManifestError, StageError
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import StageCheck, WorkspaceCheck
from recon_cli.stages import Stage
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.summaries import JsonRecord, TrainPlan, TrialDecision

Record = TypeVar("Record", bound=JsonRecord)


@dataclass(frozen=True)
class StageReport:
    """The status of one stage on the page."""

    name: str
    folder: Path  # of its result
    state: str  # as in `recon status`; "damaged" if a manifest up to it cannot be trusted
    why: str  # reasons or progress; empty where it is fresh
    command: str  # brings it up to date
    manifest: Manifest | None = None  # None without a result that can be trusted
    gone: tuple[str, ...] = ()  # inputs that no longer exist
    parts: tuple[StageReport, ...] = ()  # results beside its own that are there: exported formats

    @property
    def fresh(self) -> bool:
        """Whether its figures are those of the scene, be it of another version of recon."""
        return self.state in ("fresh", "older", "newer")

    @property
    def there(self) -> bool:
        """Whether there is a result, fresh or not."""
        return self.manifest is not None

    @property
    def summary(self) -> Mapping[str, Any]:
        """The summary in its manifest; empty without a result."""
        return self.manifest.run.summary if self.manifest else {}

    def read_summary(self, kind: type[Record]) -> Record | None:
        """Returns the summary as the stage's record; None without one that can be read."""
        try:
            return kind.from_json(self.summary) if self.manifest else None
        except ManifestError:  # of another version: the stage is stale then, and `why` says so
            return None

    @property
    def stale_suffix(self) -> str:
        """The suffix of its figures' labels: empty where they are fresh."""
        return "" if self.fresh else " (stale)"


StageReports = Mapping[str, StageReport]  # by the name of the stage


def inspect_stages(job: Job) -> dict[str, StageReport]:
    """Returns the status of every stage by name.

    StageError if ingest has not run yet, ManifestError if its manifest cannot be trusted,
    ConfigError if a setting cannot be used.
    """
    inspection = job.inspect()
    first = inspection.check("ingest")
    if first.manifest is None:
        raise StageError(
            f"The report needs ingest, which is {first.describe()}.",
            hint=f"Run `{_command(inspection, first, job.workspace.root)}` first.")
    return {row.name: _inspect_stage(inspection, row, job) for row in job.table}


def _inspect_stage(inspection: WorkspaceCheck, row: Stage, job: Job) -> StageReport:
    folder, root = job.workspace.folder(row.name), job.workspace.root
    try:
        check = inspection.check(row.name)
    except ManifestError as error:
        again = f"recon {row.verb} --again -w {shlex.quote(str(root))}"
        return StageReport(row.name, folder, "damaged", error.message, again)
    reasons, partial = [*check.reasons, *check.version_reasons], check.partial_run
    if check.state == "partial" and partial:
        reasons.insert(0, f"a run was interrupted at {partial.done} of {partial.total}")
    return StageReport(
        row.name, folder, check.state, "; ".join(filter(None, reasons)),
        _command(inspection, check, root), check.manifest, check.gone, tuple(
            part for part in (_inspect_stage(inspection, part, job) for part in row.parts)
            if part.there))


def _command(inspection: WorkspaceCheck, check: StageCheck, root: Path) -> str:
    """Returns the command with its inputs, if the stage reads any, and the workspace."""
    latest = check.partial_run or check.manifest
    inputs = [source.path for source in latest.key.sources] if latest else []
    return " ".join([
        "recon", plan.command(inspection, check), *map(shlex.quote, inputs),
        "-w", shlex.quote(str(root))])


@dataclass(frozen=True)
class StageSettings:
    """The options of one stage."""

    stage: str
    rows: tuple[tuple[str, str, str], ...]  # (option, value, the value chosen if automatic)
    seed: int | None  # None where nothing in the stage is random
    damaged: str = ""  # why the chosen values are not shown


@dataclass(frozen=True)
class Provenance:
    """Where the results come from: the section on settings."""

    settings: tuple[StageSettings, ...]  # of each stage that has a result
    stages: tuple[str, ...]  # their names, the headings of `versions`
    versions: tuple[tuple[str, ...], ...]  # (program, its version at each stage)
    commands: tuple[tuple[str, str], ...]  # (stage, the command that repeats it), in order
    sources: tuple[str, ...]  # paths of the inputs
    machine: tuple[tuple[str, str], ...]  # (label, value) of the machine that wrote the page


def read_provenance(stages: StageReports) -> Provenance:
    """Returns where the results of a workspace come from."""
    runs = {name: stage.manifest.run for name, stage in stages.items() if stage.manifest}
    programs = dict.fromkeys(program for run in runs.values() for program in run.versions)
    ingest = stages["ingest"].manifest
    return Provenance(
        tuple(_read_settings(stages[name]) for name in runs), tuple(runs),
        tuple((program, *(str(run.versions.get(program, "-")) for run in runs.values()))
              for program in programs),
        tuple((name, stages[name].command) for name in runs),
        tuple(source.path for source in ingest.key.sources) if ingest else (),
        (("recon", __version__), ("Python", platform.python_version()),
         ("system", platform.platform(terse=True)), ("processor", machine.cpu_model()),
         ("cores", str(machine.usable_threads())),
         ("memory", f"{psutil.virtual_memory().total / 1e9:.1f} GB")))


def read_decisions(train: StageReport) -> tuple[TrialDecision, ...]:
    """Returns training's decision on each optional part; empty if unreadable."""
    try:
        return TrainPlan.read(train.folder).needs if train.there else ()
    except (FormatError, ManifestError):
        return ()  # no other stage depends on plan.json


def _read_settings(stage: StageReport) -> StageSettings:
    assert stage.manifest is not None
    config, damaged = stage.manifest.key.config, ""
    chosen: Mapping[str, Any] = {}
    if stage.name == "train":
        try:
            value = read_json(stage.folder / "config.json")
            chosen = value if isinstance(value, dict) else {}
        except FormatError as error:
            damaged = f"The decisions of training are not shown: {error.message}"
    rows = tuple((
        name, _format_option(value),
        _format_option(chosen[name]) if name in chosen and chosen[name] != value else "")
        for name, value in config.items())
    return StageSettings(stage.name, rows, config.get("seed"), damaged)


def _format_option(value: Any) -> str:
    if value is None:
        return "automatic"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " ".join(map(_format_option, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
