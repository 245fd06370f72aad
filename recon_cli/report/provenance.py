"""Where the results come from: options, what training decided, versions, machine, commands."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import psutil

from recon_cli import __version__, machine
from recon_cli.errors import FormatError
from recon_cli.report.stage_status import StageStatus, Statuses
from recon_cli.workspace.atomic import read_json


@dataclass(frozen=True)
class StageSettings:
    """The options of one stage."""

    stage: str
    rows: tuple[tuple[str, str, str], ...]  # (option, value, the value chosen if automatic)
    seed: int | None  # None where nothing in the stage is random
    damaged: str = ""  # why the chosen values are not shown


@dataclass(frozen=True)
class Provenance:
    """The section on settings."""

    settings: tuple[StageSettings, ...]  # of each stage that has a result
    stages: tuple[str, ...]  # their names, the headings of `versions`
    versions: tuple[tuple[str, ...], ...]  # (program, its version at each stage)
    commands: tuple[tuple[str, str], ...]  # (stage, the command that repeats it), in order
    sources: tuple[str, ...]  # paths of the inputs
    machine: tuple[tuple[str, str], ...]  # (label, value) of the machine that wrote the page


def read_provenance(stages: Statuses) -> Provenance:
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


def read_decisions(train: StageStatus) -> tuple[Mapping[str, Any], ...]:
    """Returns name, on and reason of each part that training decided on; empty if unreadable."""
    if not train.there:
        return ()
    try:
        needs = read_json(train.folder / "plan.json")["needs"]
        return tuple({"name": str(need["name"]), "on": bool(need["on"]),
                      "reason": str(need["reason"])} for need in needs)
    except (FormatError, KeyError, TypeError):
        return ()  # a log that nothing depends on


def _read_settings(stage: StageStatus) -> StageSettings:
    assert stage.manifest is not None
    config, damaged = stage.manifest.key.config, ""
    chosen: Mapping[str, Any] = {}
    if stage.name == "train":
        try:
            value = read_json(stage.folder / "config.json")
        except FormatError as error:
            value, damaged = None, f"What training decided by itself is not shown: {error.message}"
        chosen = value if isinstance(value, dict) else {}
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
