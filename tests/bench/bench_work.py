"""CPU seconds of a command by stage, of another tree and of this one in turns.

    python tests/bench/bench_work.py ../older/.venv/bin/recon demo
    python tests/bench/bench_work.py ../older/.venv/bin/recon run ../shared/data/fox --minutes 1

Both run the command in new folders, the other tree first in every second pair. A stage's seconds
are user and system time of all processes of the tree from one stage's manifest to the next; "page"
is what follows the last. Each ratio is the median over pairs, with the least and the greatest:
walls of a shared machine are off by half within a run, such ratios by a few hundredths. With
`--cold` each run compiles its kernels anew.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import click
import psutil
import workbench

STAGES = ("ingest", "denoise", "sfm", "place", "train", "prune", "evaluate", "export")
_LOOK = 0.2  # seconds from one look at a running command to the next


def tree_seconds(process: psutil.Process) -> float:
    """Returns user and system time of a process, its children, and those that it waited for."""
    total = 0.0
    for one in (process, *process.children(recursive=True)):
        try:
            times = one.cpu_times()
        except psutil.Error:
            continue  # it has ended; its parent has its time
        total += sum(times[:4])
    return total


def run(recon: str, words: tuple[str, ...], cache: Path | None) -> dict[str, float]:
    """Returns the CPU seconds of a command by stage."""
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "w"
        environment = {**os.environ, "RECON_DEMO_WORKSPACE": str(workspace)}
        if cache is not None:
            shutil.rmtree(cache, ignore_errors=True)
            environment["RECON_CACHE_DIR"] = str(cache)
        with (Path(folder) / "log").open("w") as log:
            child = psutil.Popen(
                [recon, *words, "-w", str(workspace)], stdout=log, stderr=log, env=environment)
            marks: dict[str, float] = {}
            total = 0.0
            while child.poll() is None:
                total = max(total, tree_seconds(child))
                for name in STAGES:
                    if name not in marks and (workspace / name / "manifest.json").exists():
                        marks[name] = total
                time.sleep(_LOOK)
        if child.returncode:
            sys.exit((Path(folder) / "log").read_text())
    ends = sorted(marks.items(), key=lambda item: item[1])
    found, before = {}, 0.0
    for name, end in [*ends, ("page", total)]:
        found[name], before = end - before, end
    return {**found, "all": total}


@click.command(context_settings={"ignore_unknown_options": True})
@click.option("--pairs", default=3, show_default=True)
@click.option("--cold", is_flag=True, help="Compile kernels anew in each run.")
@click.argument("other", type=click.Path(exists=True))
@click.argument("words", nargs=-1, required=True, type=click.UNPROCESSED)
def main(pairs: int, cold: bool, other: str, words: tuple[str, ...]) -> None:
    """Prints the CPU seconds of `recon WORDS` of both trees, and their ratios."""
    own = str(Path(sys.executable).with_name("recon"))
    runs: dict[str, list[dict[str, float]]] = {other: [], own: []}
    with tempfile.TemporaryDirectory() as cache:
        for pair in range(pairs):
            for recon in (other, own) if pair % 2 else (own, other):
                runs[recon].append(run(recon, words, Path(cache) / "c" if cold else None))
                click.echo(f"{recon}: {runs[recon][-1]['all']:.1f}", err=True)
    workbench.print_head("stage", "other, CPU s", "own, CPU s", "ratio", "least", "greatest")
    for name in (*STAGES, "page", "all"):
        before, after = ([found.get(name, 0.0) for found in runs[recon]] for recon in (other, own))
        ratios = [b / a for a, b in zip(before, after, strict=True) if a]
        cells = ([f"{function(ratios):.2f}" for function in (statistics.median, min, max)]
                 if ratios else ["", "", ""])
        workbench.print_row(
            name, *(f"{statistics.median(seconds):.1f}" for seconds in (before, after)), *cells)


if __name__ == "__main__":
    main()
