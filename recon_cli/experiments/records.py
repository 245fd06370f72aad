"""Finished runs on disk, one JSON line each: what was run once is not run again.

A line is flushed before the next run starts, so that a kill loses the run at hand and no other.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from recon_cli import __version__
from recon_cli.errors import FormatError
from recon_cli.experiments.trial import Point, Run, Stand
from recon_cli.stages import stage
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.digests import sha256_json

FILE = "runs.jsonl"
_VERSION = 1  # of the lines


@dataclass(frozen=True)
class Record:
    """One finished run.

    Attributes:
        point: how it ended.
        machine: that it ran on; seconds of two machines do not compare.
        parts: optional parts of the model that were on, and the pixels trained on.
    """

    point: Point
    machine: str
    parts: str = ""


def key_of(where: Stand, digest: str, run: Run) -> str:
    """Returns what a run is known by: everything that decides about its outcome.

    Threads and the machine are left out: they move the seconds alone.

    Args:
        where: backend and device.
        digest: of the scene.
        run: arm, options, steps and seed.
    """
    versions = [__version__, *(stage(name).version for name in ("train", "prune", "evaluate"))]
    return sha256_json({
        "scene": digest, "arm": run.arm.record(), "config": run.config.hashed_fields(),
        "versions": versions, "backend": where.ctx.backend, "device": where.ctx.device})


class Records:
    """The lines of a folder, by key.

    Args:
        folder: an existing one. A last line that a kill cut short is dropped.

    Raises:
        FormatError: the file holds something else.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        text = self._path.read_text(encoding="utf-8") if self._path.exists() else ""
        whole = [line for line in text.splitlines(True) if line.endswith("\n")]
        if text != "".join(whole):
            write_bytes(self._path, "".join(whole).encode())
        self._values = dict(self._read(whole))

    def _read(self, lines: list[str]) -> Iterator[tuple[str, Mapping[str, Any]]]:
        for number, line in enumerate(lines, start=1):
            try:
                found = json.loads(line)
                if found["version"] == _VERSION:
                    yield found["key"], found["value"]
            except (ValueError, KeyError, TypeError) as error:
                raise FormatError(
                    f"{self._path}, line {number}, is no record of a run.",
                    hint="Remove that line; its run is then made again.") from error

    def run(self, key: str) -> Record | None:
        """Returns a finished run, None where there is none."""
        value = self._values.get(key)
        return None if value is None else Record(
            Point(**value["point"]), value["machine"], value["parts"])

    def steps(self, key: str) -> Mapping[str, int] | None:
        """Returns steps that were fixed by arm, None where they were not."""
        value = self._values.get(key)
        return None if value is None else value["steps"]

    def add_run(self, key: str, record: Record, run: Run, scene: str) -> None:
        """Keeps a finished run; scene, arm and seed stand beside it for whoever reads the file."""
        self._add(key, {
            **asdict(record), "scene": scene, "arm": run.arm.name, "seed": run.seed})

    def add_steps(self, key: str, steps: Mapping[str, int]) -> None:
        """Keeps the steps that arms take in the same seconds."""
        self._add(key, {"steps": dict(steps)})

    def _add(self, key: str, value: Mapping[str, Any]) -> None:
        line = json.dumps({"version": _VERSION, "key": key, "value": value}) + "\n"
        with self._path.open("a", encoding="utf-8") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self._values[key] = value
