"""Injects faults into a tiny workspace and says how each ended: `make faults SEED=1 COUNT=1000`.

`--only N` repeats one fault of a seed, with `-v` everything that it did. Exit code 1 where a fault
ended in neither the right result nor a clear error.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[2]
sys.path[1:1] = [str(ROOT / "tests"), str(ROOT / "tests" / "bench")]
# Threads do not survive a fork, so nothing may start any; torch and others look here on import.
os.environ.update(dict.fromkeys((
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"))
# As in tests/conftest.py: kernels are kept from run to run, but not among the user's own.
os.environ.setdefault("RECON_CACHE_DIR", str(ROOT / ".pytest_cache" / "recon"))
os.environ.pop("RECON_WORKSPACE", None)

import forked
from case import Case
from disk_kinds import can_mount
from judge import Outcome, Verdict
from kinds import KINDS, schedule
from lab import Lab, make

FAULT_SECONDS = 400  # a fault runs a few commands, each with a limit of its own


def _run_fault(root: Path, seed: int, number: int, keep: bool) -> dict[str, object]:
    """Injects one fault, in this process; returns its row of the report."""
    kind, turn = schedule(number + 1)[number]
    folder = Path(tempfile.mkdtemp(prefix=f"{number}-", dir=root / "faults"))
    case = Case(Lab.load(root), random.Random(f"{seed} {number}"), turn + 131 * seed, folder)
    begin = time.monotonic()
    try:
        verdict = kind.inject(case)
    except Exception:
        verdict = Verdict(Outcome.BUG, f"of the campaign itself:\n{traceback.format_exc()}")
    if not keep:
        shutil.rmtree(folder, ignore_errors=True)
    return {"number": number, "kind": kind.name, "outcome": int(verdict.outcome),
            "detail": verdict.detail, "story": case.story, "seconds": time.monotonic() - begin,
            "folder": str(folder)}


def _fork_fault(root: Path, seed: int, number: int, keep: bool) -> None:
    """Injects one fault in a child, so that whatever happens to it ends with it."""
    report = root / "reports" / f"{number}.json"
    pid = os.fork()
    if pid == 0:
        try:
            os.setpgid(0, 0)
            forked.adopt_orphans()
            signal.alarm(FAULT_SECONDS)
            row = _run_fault(root, seed, number, keep)
            report.write_text(json.dumps(row))
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    forked.end_children()
    if not report.exists():
        report.write_text(json.dumps({
            "number": number, "kind": "campaign", "outcome": int(Outcome.HANG), "story": [],
            "detail": "the fault did not end", "seconds": FAULT_SECONDS, "folder": ""}))


def _work(root: Path, seed: int, numbers: list[int], core: int, keep: bool, end: float) -> None:
    """Takes faults that nobody took yet, until there are none or the time is up."""
    forked.adopt_orphans()
    os.sched_setaffinity(0, {core})  # one thread a fault: as many faults at once as cores
    for number in numbers:
        if time.monotonic() > end:
            return
        with contextlib.suppress(FileExistsError):
            os.close(os.open(root / "taken" / str(number), os.O_CREAT | os.O_EXCL))
            _fork_fault(root, seed, number, keep)


def _run_all(root: Path, seed: int, numbers: list[int], *, workers: int, keep: bool,
             verbose: bool, end: float) -> list[dict[str, object]]:
    for name in ("faults", "reports", "taken"):
        (root / name).mkdir()
    cores = sorted(os.sched_getaffinity(0))
    children = []
    for worker in range(workers):
        pid = os.fork()
        if pid == 0:
            try:
                _work(root, seed, numbers, cores[worker % len(cores)], keep, end)
            finally:
                os._exit(0)
        children.append(pid)
    rows: list[dict[str, object]] = []
    seen: set[str] = set()
    while children:
        children = [pid for pid in children if not os.waitpid(pid, os.WNOHANG)[0]]
        for path in (root / "reports").glob("*.json"):
            if path.name in seen or not (text := path.read_text()).endswith("}"):
                continue
            seen.add(path.name)
            rows.append(json.loads(text))
            _print_row(rows[-1], seed, verbose)
        time.sleep(0.1)
    return rows


def _print_row(row: dict[str, object], seed: int, verbose: bool) -> None:

    outcome = Outcome(row["outcome"])
    if verbose:
        click.echo("\n".join(map(str, row["story"])))
        click.echo(f"{row['kind']}: {outcome.words}: {row['detail']} ({row['seconds']:.1f} s)")
    elif outcome > Outcome.CLEAR_ERROR:
        click.echo(
            f"{outcome.words}: {row['kind']} {row['number']}: {_first(row)} | {row['detail']}\n"
            f"    python tests/faults/run.py --seed {seed} --only {row['number']} -v")


def _first(row: dict[str, object]) -> str:
    story = row["story"]
    return str(story[0]).splitlines()[0] if story else ""


def _table(rows: list[dict[str, object]]) -> str:
    """Returns kinds by outcome."""
    counts = Counter((row["kind"], row["outcome"]) for row in rows)
    names = [kind.name for kind in KINDS] + ["campaign"]
    lines = [["kind", *(outcome.words for outcome in Outcome)]]
    lines += [[name, *(str(counts[name, outcome] or "") for outcome in Outcome)]
              for name in names if any(counts[name, outcome] for outcome in Outcome)]
    lines.append(["all", *(str(sum(counts[name, outcome] for name in names))
                           for outcome in Outcome)])
    widths = [max(len(line[at]) for line in lines) for at in range(len(lines[0]))]
    return "\n".join("  ".join(
        [line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(
            line[1:], widths[1:], strict=True))]) for line in lines)


@click.command()
@click.option("--seed", default=1, show_default=True, help="Of all faults.")
@click.option("--count", default=1000, show_default=True, help="How many faults.")
@click.option("--only", type=int, multiple=True, help="Inject only the faults of these numbers.")
@click.option("--kind", help="Inject only faults of this kind.")
@click.option("--workers", type=int, help="At once.  [default: one a core]")
@click.option("--minutes", default=60.0, show_default=True, help="Begin no fault after so many.")
@click.option("--keep", is_flag=True, help="Keep the folders of the faults.")
@click.option("-v", "--verbose", is_flag=True, help="Print what each fault did.")
def main(seed: int, count: int, only: tuple[int, ...], kind: str | None, workers: int | None,
         minutes: float, keep: bool, verbose: bool) -> None:
    """Inject faults; print what ended badly, and a table of kinds by outcome."""
    begin = time.monotonic()
    sys.stdout.reconfigure(errors="backslashreplace")  # names need not be UTF-8
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})  # results must be those of one thread, like the faults'
    forked.preload()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # pycolmap would print its stack
    # A shell lets what it runs in the background ignore Ctrl-C, and all below inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    numbers = list(only) or [number for number, (each, _) in enumerate(schedule(count))
                             if kind in (None, each.name)]
    root = Path(tempfile.mkdtemp(prefix="recon-faults-"))
    try:
        forked.adopt_orphans()
        make(root, random.Random(seed))
        disks = "a tmpfs" if can_mount(root / "making") else "a limit on files, for want of a tmpfs"
        click.echo(f"{len(numbers)} faults of seed {seed}, in {root} "
                   f"({time.monotonic() - begin:.0f} s to prepare); full disks are {disks}")
        os.sched_setaffinity(0, cores)
        rows = _run_all(root, seed, numbers, workers=workers or len(cores), keep=keep,
                        verbose=verbose, end=time.monotonic() + 60 * minutes)
    finally:
        if not keep:
            shutil.rmtree(root, ignore_errors=True)
    click.echo(_table(rows))
    bad = sum(row["outcome"] > 1 for row in rows)
    slow = sorted(rows, key=lambda row: -row["seconds"])[:3]
    if len(rows) < len(numbers):
        click.echo(f"{len(numbers) - len(rows)} faults were not begun: {minutes:g} minutes are up")
    click.echo(f"{bad} of {len(rows)} ended in neither the right result nor a clear error; "
               f"{time.monotonic() - begin:.0f} s; slowest: " + ", ".join(
                   f"{row['kind']} {row['number']} ({row['seconds']:.0f} s)" for row in slow))
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
