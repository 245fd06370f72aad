"""The figures of `bench_gpu.py`: each printed at once, and all in one table at the end."""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import click
import torch

from recon_cli import machine
from recon_cli.workspace import atomic

_LONGEST = 300  # characters of a failure in the table
_GRACE = 40  # seconds after the deadline in which a part may still end by itself


@dataclass(frozen=True)
class Figure:
    """One number.

    Attributes:
        name: of the thing that was measured.
        value: None where it could not be measured; the note says why.
        unit: of the value.
        note: how it was measured.
    """

    name: str
    value: float | None
    unit: str
    note: str

    def row(self) -> str:
        """Returns the line of the table."""
        return f"| {self.name} | {self.text()} | {self.note} |"

    def text(self) -> str:
        """Returns the value with its unit, to about three digits."""
        if self.value is None:
            return "-"
        digits = 0 if abs(self.value) >= 100 else 1 if abs(self.value) >= 10 else 2
        return f"{self.value:,.{digits}f} {self.unit}".rstrip()


@dataclass
class Figures:
    """All figures so far, and how much time is left.

    Attributes:
        device: "cuda" or "cpu".
        seconds: that all parts together may take.
        figures: in the order of their measurement.
        failures: checks that failed and parts that broke off.
    """

    device: str
    seconds: float
    figures: list[Figure] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._begin = time.monotonic()

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return self.seconds - (time.monotonic() - self._begin)

    def say(self, text: str) -> None:
        """Prints a line at once, with the seconds since the start."""
        click.echo(f"[{time.monotonic() - self._begin:5.0f} s] {text}")

    def add(self, name: str, value: float | None, unit: str, *, note: str = "") -> None:
        """Keeps a figure and prints it."""
        self.figures.append(Figure(name, value, unit, note))
        self.say(f"{name}: {self.figures[-1].text()}{' (' + note + ')' if note else ''}")

    def check(self, good: bool, name: str, found: str) -> None:
        """Prints the result of a check, and keeps it where it failed."""
        self.say(f"{'ok' if good else 'FAILED'}: {name}: {found}")
        if not good:
            self.failures.append(f"{name}: {found}")

    def part(self, name: str, work: Callable[[], None]) -> None:
        """Does a part of the work; if it breaks off, earlier figures stay."""
        if self.left <= 0:
            self.say(f"{name}: left out, the time is over")
            self.figures.append(Figure(name, None, "", "left out, the time is over"))
            return
        self.say(f"-- {name}")
        try:
            work()
        except Exception as error:  # whatever it is, the table must come
            click.echo(traceback.format_exc())
            said = " ".join(f"{type(error).__name__}: {error}".split())
            self.failures.append(f"{name} broke off: {said}"[:_LONGEST])

    def table(self) -> str:
        """Returns all figures in Markdown, and what failed."""
        name = torch.cuda.get_device_name() if self.device == "cuda" else (
            f"{machine.cpu_model()}, triton's interpreter: no figure means anything")
        lines = [f"{name}, torch {torch.__version__}", "",
                 "| figure | measured | |", "|---|---:|---|",
                 *(figure.row() for figure in self.figures), ""]
        lines += [f"FAILED: {failure}" for failure in self.failures] or ["All checks passed."]
        return "\n".join(lines)

    def write(self, path: Path) -> None:
        """Writes everything as JSON."""
        atomic.write_json(path, {
            "device": torch.cuda.get_device_name() if self.device == "cuda" else "cpu",
            "versions": machine.versions(), "figures": [asdict(one) for one in self.figures],
            "failures": self.failures})

    def watch(self, out: Path | None) -> threading.Timer:
        """Returns a running clock that prints the table and ends all when a part hangs."""

        def over() -> None:
            self.failures.append("a part did not end in time")
            click.echo(self.table())
            if out is not None:
                self.write(out)
            os._exit(1)  # a thread that waits for the device cannot be stopped

        clock = threading.Timer(max(0.0, self.left) + _GRACE, over)
        clock.daemon = True
        clock.start()
        return clock
