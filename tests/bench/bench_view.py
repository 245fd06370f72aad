"""What `recon train --view` costs: python tests/bench/bench_view.py WORKSPACE [--rounds N].

Copies a workspace whose sfm is finished and trains it again and again: without --view, with it and
nobody looking, and with a headless Chromium that has the page open from the start (its WebGL is
SwiftShader, in software, on the same processors: the worst case). The three take turns, in another
order each round, and what is compared are the seconds of training that the log counts.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from browser import browser, watched

KINDS = ("without", "nobody", "looked at")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=1500)
    asked = parser.parse_args()
    seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "ws"
        for stage in ("ingest", "denoise", "sfm"):
            shutil.copytree(asked.workspace / stage, workspace / stage)
        digests = set()
        for number in range(asked.rounds):
            for kind in (*KINDS[number % 3:], *KINDS[:number % 3]):
                seconds[kind].append(train(workspace, kind, asked.iterations, asked.threads))
                digests.add((workspace / "train" / "splats.ply").read_bytes())
    plain = statistics.median(seconds["without"])
    for kind, values in seconds.items():
        shown = ", ".join(f"{value:.1f}" for value in values)
        print(f"{kind:10} {shown} s; median {statistics.median(values) / plain:.3f} of without")
    print(f"{len(digests)} different splats.ply")


def train(workspace: Path, kind: str, iterations: int, threads: int) -> float:
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
            with browser() as chromium, watched(chromium) as page:
                page.page.goto(address[0])
                process.communicate()
        assert process.returncode == 0
    log = (workspace / "train" / "log.jsonl").read_text(encoding="utf-8").splitlines()
    return float(json.loads(log[-1])["seconds"])


if __name__ == "__main__":
    main()
