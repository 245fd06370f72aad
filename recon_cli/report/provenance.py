"""Where the result comes from: settings, versions, machine, commands to repeat it."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import psutil

from recon_cli import __version__, machine
from recon_cli.errors import FormatError
from recon_cli.report.stage_status import Standing
from recon_cli.workspace.atomic import read_json

_DECIDED = "config.json"  # of train: numbers in place of what was left automatic


@dataclass(frozen=True)
class Settings:
    """The options of one stage.

    Attributes:
        stage: its name.
        rows: (option, value, what was decided where it was left automatic, else empty).
        seed: of the stage; None where nothing in it is random.
        damaged: why what was decided is not shown; empty otherwise.
    """

    stage: str
    rows: tuple[tuple[str, str, str], ...]
    seed: int | None
    damaged: str = ""


@dataclass(frozen=True)
class Provenance:
    """All of it.

    Attributes:
        settings: of each stage that has a result.
        stages: names of these stages, the headings of `versions`.
        versions: (program, its version at each stage).
        commands: (stage, what to type to repeat it), in order.
        sources: paths of the inputs.
        machine: (what, value) of the machine that wrote the page.
    """

    settings: tuple[Settings, ...]
    stages: tuple[str, ...]
    versions: tuple[tuple[str, ...], ...]
    commands: tuple[tuple[str, str], ...]
    sources: tuple[str, ...]
    machine: tuple[tuple[str, str], ...]


def provenance(stages: Mapping[str, Standing]) -> Provenance:
    """Returns where the results of a workspace come from."""
    there = {name: one for name, one in stages.items() if one.manifest}
    names = list(dict.fromkeys(
        name for one in there.values() if one.manifest for name in one.manifest.run.versions))
    versions = tuple((name, *(
        str(one.manifest.run.versions.get(name, "-")) for one in there.values() if one.manifest))
        for name in names)
    ingest = stages["ingest"].manifest
    return Provenance(
        tuple(_settings(one) for one in there.values()), tuple(there), versions,
        tuple((name, one.command) for name, one in there.items()),
        tuple(source.path for source in ingest.basis.sources) if ingest else (),
        _machine())


def _settings(stage: Standing) -> Settings:
    assert stage.manifest is not None
    config, damaged = stage.manifest.basis.config, ""
    decided: Mapping[str, Any] = {}
    if stage.name == "train":
        try:
            read = read_json(stage.folder / _DECIDED)
        except FormatError as error:
            read, damaged = None, f"What training decided by itself is not shown: {error.message}"
        decided = read if isinstance(read, dict) else {}
    rows = tuple((
        name, _shown(value),
        _shown(decided[name]) if name in decided and decided[name] != value else "")
        for name, value in config.items())
    return Settings(stage.name, rows, config.get("seed"), damaged)


def _shown(value: Any) -> str:
    if value is None:
        return "automatic"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _machine() -> tuple[tuple[str, str], ...]:
    return (
        ("recon", __version__), ("Python", platform.python_version()),
        ("system", platform.platform(terse=True)), ("processor", machine.cpu_model()),
        ("cores", str(machine.usable_threads())),
        ("memory", f"{psutil.virtual_memory().total / 1e9:.1f} GB"))
