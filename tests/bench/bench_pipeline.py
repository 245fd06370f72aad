"""Which stage used how many cores when: `python tests/bench/bench_pipeline.py VIDEO OUT [-- ...]`.

Runs `recon run VIDEO` with the options after `--` in the workspace OUT, and prints a row for each
stage and progress bar, and a chart with a line a core. Ten times a second the CPU seconds of all
processes are sampled, and on Linux also how long their threads waited for a core: what others on
the machine take is then not counted as idle, and "alone" is how long all would take without them.
`--cold` has the kernels compiled anew.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import click
import psutil

from recon_cli.machine import usable_threads
from recon_cli.stages import STAGES

PERIOD = 0.1  # seconds
TREE_EVERY = 3  # samples; a look at the process tree takes milliseconds
ONE_CORE = 1.15  # up to here one core is busy: the kernel counts in hundredths, and bars are drawn
COLUMNS = 100
SHADES = " .:#"  # of the share of time in which a core is in use
NUMBER = re.compile(r" \d+$")  # of a round
BAR = re.compile(rb"^\s*(.+?): +\d+%\|")


@dataclass(frozen=True)
class Sample:
    """What happened in a period."""

    begin: float  # seconds since the start
    seconds: float
    stage: str
    phase: str  # the label of the progress bar; empty where there is none
    busy: float  # core seconds
    waiting: float  # seconds in which a thread could run and had no core

    @property
    def wanted(self) -> float:
        """How many cores were in use, or would have been on an idle machine."""
        return (self.busy + self.waiting) / self.seconds

    def alone(self, cores: int) -> float:
        """How long its work would have taken where nothing else runs, in seconds."""
        return self.busy / min(cores, self.wanted) if self.busy else self.seconds


class Usage:
    """CPU seconds of a process and of all that it starts; what has ended still counts."""

    def __init__(self, pid: int) -> None:
        self._root, self._looks = psutil.Process(pid), 0
        self._processes: dict[int, psutil.Process] = {}
        self._commands: dict[int, str] = {}
        self._busy: dict[int, float] = {}
        self._waiting: dict[tuple[int, str], float] = {}

    def look(self) -> tuple[float, float]:
        """Returns the seconds that cores were busy, and that threads waited for one."""
        if self._looks % TREE_EVERY == 0:
            with contextlib.suppress(psutil.Error):
                tree = [self._root, *self._root.children(recursive=True)]
                self._processes = {process.pid: process for process in tree}
        self._looks += 1
        for pid, process in self._processes.items():
            with contextlib.suppress(psutil.Error, OSError):
                times = process.cpu_times()
                self._busy[pid] = times.user + times.system
                self._commands.setdefault(pid, _describe(process.cmdline()))
                for thread in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                    with contextlib.suppress(OSError):  # it has ended
                        nanoseconds = int(thread.read_text().split()[1])
                        self._waiting[pid, thread.parent.name] = nanoseconds / 1e9
        return sum(self._busy.values()), sum(self._waiting.values())

    def by_command(self) -> dict[str, float]:
        """Returns the CPU seconds by what the processes run."""
        seconds: dict[str, float] = {}
        for pid, command in self._commands.items():
            seconds[command] = seconds.get(command, 0.0) + self._busy[pid]
        return seconds


def _describe(command: Sequence[str]) -> str:
    """Returns the module that a process runs."""
    modules = [word for before, word in itertools.pairwise(command) if before == "-m"]
    return modules[0] if modules else Path(command[0]).name if command else "?"


class Bars:
    """Reads the progress bars of a process and passes on what else it writes."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.label = ""
        self._stream = stream
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Waits for the end of the stream."""
        self._thread.join()

    def _read(self) -> None:
        line = b""
        while byte := self._stream.read(1):
            line += byte
            if byte == b"\n":
                self._end(line)
                line = b""
            elif byte == b"\r" or line.endswith(b"|"):
                if bar := BAR.match(line):
                    self.label = NUMBER.sub("", bar[1].decode())
                line = b"" if byte == b"\r" else line

    def _end(self, line: bytes) -> None:
        if BAR.match(line):
            self.label = ""  # a bar that ends leaves its line
        elif line.strip():
            sys.stderr.buffer.write(line)
            sys.stderr.flush()


def watch(command: Sequence[str], workspace: Path) -> tuple[list[Sample], dict[str, float]]:
    """Runs a command and returns its samples, and the CPU seconds by what its processes run."""
    samples = []
    with subprocess.Popen(command, stderr=subprocess.PIPE, bufsize=0) as child:
        assert child.stderr is not None
        bars, usage = Bars(child.stderr), Usage(child.pid)
        start = before = time.perf_counter()
        busy, waiting = usage.look()
        try:
            while child.poll() is None:
                time.sleep(max(0.0, PERIOD - (time.perf_counter() - before)))
                stage, phase, now = _stage(workspace), bars.label, time.perf_counter()
                busy_now, waiting_now = usage.look()
                samples.append(Sample(
                    before - start, now - before, stage, phase, busy_now - busy,
                    max(0.0, waiting_now - waiting)))
                before, busy, waiting = now, busy_now, waiting_now
        except BaseException:
            child.terminate()
            raise
        bars.join()
        if child.returncode:
            raise click.ClickException(f"recon ended with exit code {child.returncode}")
    return samples, usage.by_command()


def _stage(workspace: Path) -> str:
    """Returns the stage that is writing."""
    running = [row.name for row in STAGES if (workspace / ".partial" / row.name).is_dir()]
    return running[-1] if running else "between"


def table(samples: Sequence[Sample]) -> str:
    """Returns a row a stage, below it one for each of its phases, in the order of their begin."""
    rows = ["| stage | wall s | alone, s | core s | cores, mean | s with one core or none |",
            "|---|---:|---:|---:|---:|---:|", _row("**all**", samples)]
    for stage in dict.fromkeys(sample.stage for sample in samples):
        own = [sample for sample in samples if sample.stage == stage]
        rows.append(_row(f"**{stage}**", own))
        phases = _name_phases(own)
        if len(phases) > 1:
            rows += [_row(name, phase) for name, phase in phases.items()]
    return "\n".join(rows)


def _name_phases(samples: Sequence[Sample]) -> dict[str, list[Sample]]:
    """Returns the phases of a stage by name; what has no bar is named after the next one."""
    phases: dict[str, list[Sample]] = {}
    runs = [(label, list(run)) for label, run in itertools.groupby(samples, lambda one: one.phase)]
    for (label, run), (following, _) in itertools.pairwise([*runs, ("", [])]):
        name = label or (f"before {following}" if following else "after the last bar")
        phases.setdefault(name, []).extend(run)
    return phases


def _row(name: str, samples: Sequence[Sample]) -> str:
    wall, busy = sum(one.seconds for one in samples), sum(one.busy for one in samples)
    wanted = sum(one.busy + one.waiting for one in samples)
    alone = [one.alone(usable_threads()) for one in samples]
    idle = sum(time for one, time in zip(samples, alone, strict=True) if one.wanted <= ONE_CORE)
    return (f"| {name} | {wall:.1f} | {sum(alone):.1f} | {busy:.1f} | {wanted / wall:.2f} | "
            f"{idle:.1f} |")


def chart(samples: Sequence[Sample], cores: int) -> str:
    """Returns a line a core, the first one the busiest, over a line with the stages' letters."""
    end = samples[-1].begin + samples[-1].seconds
    columns: list[list[Sample]] = [[] for _ in range(COLUMNS)]
    for sample in samples:
        columns[min(COLUMNS - 1, int(COLUMNS * sample.begin / end))].append(sample)
    lines = []
    for core in range(cores):
        shares = [_share(column, core) for column in columns]
        text = "".join(SHADES[min(len(SHADES) - 1, int(share * len(SHADES)))] for share in shares)
        lines.append(f"core {core + 1} |{text}|")
    letters = {row.name: row.name[:2] if row.name == "export" else row.name[0] for row in STAGES}
    stages = "".join(letters.get(column[0].stage, " ")[-1] if column else " " for column in columns)
    legend = ", ".join(f"{letters[row.name][-1]} {row.name}" for row in STAGES)
    return "\n".join([*lines, f"stage  |{stages}|", f"0 to {end:.0f} s; {legend}"])


def _share(column: Sequence[Sample], core: int) -> float:
    """Returns how much of the time of a column a core was in use."""
    used = sum(min(1.0, max(0.0, one.wanted - core)) * one.seconds for one in column)
    return used / max(1e-9, sum(one.seconds for one in column))


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("video", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
@click.option("--cold", is_flag=True, help="Have the kernels compiled in an empty cache.")
def main(video: Path, out: Path, options: tuple[str, ...], cold: bool) -> None:
    """Prints the table and the chart of one run."""
    if out.exists():
        raise click.ClickException(f"{out} exists: nothing would be run anew.")
    cache = out.with_name(f"{out.name}.cache")
    if cold:
        shutil.rmtree(cache, ignore_errors=True)
        os.environ["RECON_CACHE_DIR"] = str(cache.absolute())
    command = [sys.executable, "-m", "recon_cli", "run", str(video), "-w", str(out), *options]
    samples, commands = watch(command, out)
    click.echo(f"\n{table(samples)}\n\n{chart(samples, usable_threads())}\n")
    click.echo("CPU seconds of processes: " + ", ".join(
        f"{name} {seconds:.1f}" for name, seconds in commands.items()))
    if cold:
        shutil.rmtree(cache)


if __name__ == "__main__":
    main()
