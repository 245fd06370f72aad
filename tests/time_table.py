"""Where the tests' time goes: `python tests/time_table.py [pytest's arguments]` or `make times`.

Runs pytest with itself as a plugin, and prints CPU seconds of its processes and of programs that
these waited for: of collecting, summed over the workers; of fixtures; of tests, by folder, by file
and one by one. Last, the seconds that importing the modules of the tests takes in one process, by
package.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import click
import pytest

FOLDER = "TIME_TABLE"  # environment variable: where each process writes what it measured
TESTS = Path(__file__).parent
ROWS = int(os.environ.get("ROWS", "25"))  # of a table
LENGTHS = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0)
LONG = 0.3  # CPU seconds, from which on a test needs a marker

_spent: dict[str, Counter[str]] = {
    "collected": Counter(), "fixtures": Counter(), "tests": Counter()}


def spent_s() -> float:
    """CPU seconds of this process and of its children that ended."""
    return time.process_time() + sum(os.times()[2:4])


@contextmanager
def _measured(table: str, name: str) -> Iterator[None]:
    began = spent_s()
    try:
        yield
    finally:
        _spent[table][name] += spent_s() - began


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Measures the import of a file of tests, with all that it is the first to import."""
    with _measured("collected", collector.nodeid if isinstance(collector, pytest.File) else ""):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object]
) -> Generator[None, object, object]:
    """Measures a fixture, without those that it names as arguments."""
    with _measured("fixtures", f"{fixturedef.baseid}:{fixturedef.argname}"):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measures a test, with the fixtures that it is the first to ask for."""
    with _measured("tests", item.nodeid):
        return (yield)


def pytest_sessionfinish() -> None:
    """Writes what this process measured."""
    name = os.environ.get("PYTEST_XDIST_WORKER", "main")
    Path(os.environ[FOLDER], f"{name}.json").write_text(json.dumps(_spent))


def _print_table(title: str, spent: Counter[str], *, least: float = 0.0) -> None:
    rows = [(name, seconds) for name, seconds in spent.most_common() if seconds >= least][:ROWS]
    click.echo(f"\n| {title} | s | share |\n|---|---:|---:|")
    for name, seconds in rows:
        click.echo(f"| {name or '-'} | {seconds:.1f} | {seconds / max(spent.total(), 1e-9):.0%} |")
    click.echo(f"| all {len(spent)} | {spent.total():.1f} | |")


def _print_lengths(spent: Counter[str]) -> None:
    """Prints how many tests take how long, and how much of all they take together."""
    click.echo("\n| tests from .. s | tests | s |\n|---|---:|---:|")
    for least, most in pairwise((*LENGTHS, math.inf)):
        some = [seconds for seconds in spent.values() if least <= seconds < most]
        click.echo(f"| {least:g} | {len(some)} | {sum(some):.0f} |")


def _sum_by(spent: Counter[str], level: int) -> Counter[str]:
    """Sums over tests by their file, or by the first `level` folders of their path."""
    sums: Counter[str] = Counter()
    for name, seconds in spent.items():
        path = Path(name.partition("::")[0])
        sums[str(Path(*path.parts[:level]))] += seconds
    return sums


def _import_costs() -> Counter[str]:
    """Seconds of importing all modules of tests, by package, each without what it imports."""
    command = [sys.executable, "-X", "importtime", "-m", "pytest", "-qs", "-p", "no:xdist",
               "--collect-only", str(TESTS)]
    lines = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=TESTS.parent).stderr.splitlines()
    costs: Counter[str] = Counter()
    for line in lines:
        own, _, rest = line.removeprefix("import time:").partition("|")
        if line.startswith("import time:") and own.strip().isdigit():
            costs[rest.partition("|")[2].strip().partition(".")[0]] += int(own) / 1e6
    return costs


def main(arguments: list[str]) -> int:
    """Runs pytest and prints the tables."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, FOLDER: folder, "PYTHONPATH": str(TESTS)}
        command = [sys.executable, "-m", "pytest", "-q", "-p", "time_table", *arguments]
        code = subprocess.run(
            command, env=environment, check=False, cwd=TESTS.parent).returncode
        spent = [json.loads(path.read_text()) for path in Path(folder).glob("*.json")]
    tables: dict[str, Counter[str]] = {name: Counter() for name in _spent}
    for name, table in tables.items():
        for process in spent:
            table.update(process[name])
    click.echo(f"\nCPU s in all: {spent_s():.0f}")
    _print_lengths(tables["tests"])
    _print_table("collected", tables["collected"])
    _print_table("fixture", tables["fixtures"])
    _print_table("folder", _sum_by(tables["tests"], 2))
    _print_table("file", _sum_by(tables["tests"], 9))
    _print_table(f"test of {LONG:g} s or more", tables["tests"], least=LONG)
    _print_table("import", _import_costs())
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
