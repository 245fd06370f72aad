"""The log of a training: one JSON line a report, and what is read from it later."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from recon_cli.atomic import write_bytes
from recon_cli.train.fit import Report

LOG = "log.jsonl"


def seconds_at(log: Path, iteration: int, *, clock: str = "seconds") -> float:
    """Returns the training seconds that a log counts up to an iteration, by one of its clocks."""
    seconds = 0.0
    for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else []:
        row = json.loads(line)
        if row["iteration"] <= iteration:
            seconds = float(row[clock])
    return seconds


class Log:
    """One JSON line a report; what a crash left behind the checkpoint is cut off."""

    def __init__(self, path: Path, iteration: int, earlier_seconds: float) -> None:
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines(True) if path.exists() else []
        # a kill in mid-write leaves a last line without its end
        whole = [line for line in lines if line.endswith("\n")]
        kept = [line for line in whole if json.loads(line)["iteration"] <= iteration]
        if not kept:  # a branch starts where the other run stood
            first = {"iteration": iteration, "seconds": earlier_seconds, "cpu_seconds": 0.0}
            kept = [json.dumps(first) + "\n"]
        write_bytes(path, "".join(kept).encode())
        self._earlier = seconds_at(path, iteration)
        self._earlier_cpu = seconds_at(path, iteration, clock="cpu_seconds")

    def add(self, report: Report) -> None:
        """Appends a report; its seconds count from the very start of training."""
        self._write(dataclasses.asdict(report), report.seconds, report.cpu_seconds)

    def spend(self, iteration: int, seconds: float, cpu_seconds: float) -> None:
        """Counts time in which no step was taken."""
        self._write({"iteration": iteration}, seconds, cpu_seconds)

    def _write(self, row: dict[str, object], seconds: float, cpu_seconds: float) -> None:
        row["seconds"] = round(self._earlier + seconds, 3)
        row["cpu_seconds"] = round(self._earlier_cpu + cpu_seconds, 3)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
