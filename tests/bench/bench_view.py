"""What `recon train --view` costs: python tests/bench/bench_view.py WORKSPACE [--rounds N].

Copies a workspace whose sfm is finished and trains it again and again: without --view, with it and
nobody looking, and with a headless Chromium that has the page open from the start (its WebGL is
SwiftShader, in software, on the same processors: the worst case). The three take turns, in another
order each round, and what is compared are the seconds of training that the log counts: of the
clock, and of this process on all processors, which other programs hardly change.
"""

from __future__ import annotations

import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import click
from browser import launch_browser, watch_page

KINDS = ("without", "nobody", "looked at")


@click.command()
@click.argument("source", type=click.Path(exists=True, path_type=Path))
@click.option("--rounds", default=3)
@click.option("--threads", default=1)
@click.option("--iterations", default=1500)
def main(source: Path, rounds: int, threads: int, iterations: int) -> None:
    """Prints the seconds of each kind and their ratio to those without."""
    seconds: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "ws"
        for stage in ("ingest", "denoise", "sfm", "place"):
            shutil.copytree(source / stage, workspace / stage)
        results = set()
        for number in range(rounds):
            for kind in (*KINDS[number % 3:], *KINDS[:number % 3]):
                seconds[kind].append(train(workspace, kind, iterations, threads))
                results.add((workspace / "train" / "splats.ply").read_bytes())
    for kind in KINDS:
        for at, what in enumerate(("wall", "CPU")):
            values, plain = ([one[at] for one in seconds[name]] for name in (kind, KINDS[0]))
            ratios = [value / other for value, other in zip(values, plain, strict=True)]
            shown = ", ".join(f"{value:.1f}" for value in values)
            click.echo(
                f"{kind:10} {what:4} {shown} s; median of the rounds "
                f"{statistics.median(ratios):.3f} of without; "
                f"shortest {min(values) / min(plain):.3f}")
    click.echo(f"{len(results)} different splats.ply")


def train(
    workspace: Path, kind: str, iterations: int, threads: int
) -> tuple[float, float]:
    """Returns the wall and the CPU seconds of a training."""
    command = [
        sys.executable, "-m", "recon_cli", "train", "-w", str(workspace), "--again",
        "--threads", str(threads), "--iterations", str(iterations), "--no-early-stop"]
    if kind == "without":
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    else:
        process = subprocess.Popen(
            [*command, "--view"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert process.stdout
        address = re.search(r"http://\S+", process.stdout.readline())
        assert address
        if kind == "nobody":
            process.communicate()
        else:
            with launch_browser() as chromium, watch_page(chromium) as page:
                page.page.goto(address[0])
                process.communicate()
        assert process.returncode == 0
    log = (workspace / "train" / "log.jsonl").read_text(encoding="utf-8").splitlines()
    last = json.loads(log[-1])
    return float(last["seconds"]), float(last["cpu_seconds"])


if __name__ == "__main__":
    main()
