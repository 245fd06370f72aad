"""Prints what `recon train` reaches in given minutes, over seeds: `python bench_budget.py --help`.

WORKSPACES have their sfm done; they are copied, and the copies trained and scored on the held-out
views. Seconds are those of the training alone: trials, calibration, steps and reports.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from pathlib import Path


def trained(workspace: Path, words: list[str]) -> dict[str, float]:
    """Trains and scores; returns PSNR, SSIM, training PSNR, count, megabytes, steps, seconds."""
    command = [sys.executable, "-m", "recon_cli"]
    subprocess.run([*command, "train", "-w", workspace, "--again", *words], check=True,
                   capture_output=True)
    subprocess.run([*command, "eval", "-w", workspace], check=True, capture_output=True)
    plan = json.loads((workspace / "train" / "plan.json").read_text(encoding="utf-8"))
    summary = json.loads(
        (workspace / "train" / "manifest.json").read_text(encoding="utf-8"))["summary"]
    model = json.loads(
        (workspace / "evaluate" / "metrics.json").read_text(encoding="utf-8"))["models"]["base"]
    before = sum(need["seconds"] for need in plan["needs"]) + plan["cost"]["seconds"]
    return {
        "psnr": model["psnr_db"], "ssim": model["ssim"], "gaussians": model["gaussians"],
        "mb": model["bytes"] / 1e6, "steps": summary["iterations"],
        "degree": summary["parts"]["sh_degree"],
        "seconds": before + summary["train_seconds"]}


def row(name: str, minutes: float, runs: list[dict[str, float]]) -> str:
    """Returns the medians of some runs as a line of a table."""
    def middle(key: str) -> float:
        return statistics.median(run[key] for run in runs)

    scores = [run["psnr"] for run in runs]
    spread = f"{statistics.stdev(scores):.2f}" if len(scores) > 1 else ""
    return (f"| {name} | {60 * minutes:.0f} | {middle('seconds'):.0f} | {middle('steps'):,.0f} | "
            f"{middle('gaussians'):,.0f} | {middle('degree'):.0f} | {middle('mb'):.1f} | "
            f"{middle('psnr'):.2f} / {middle('ssim'):.3f} | {spread} | {len(runs)} |")


def say(line: str) -> None:
    """Writes a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Prints a table of medians."""
    parser = argparse.ArgumentParser()
    parser.add_argument("workspaces", nargs="+", type=Path)
    parser.add_argument("--minutes", type=float, action="append")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    asked = parser.parse_args()
    more = [word for text in asked.set for word in ("--" + text).split("=")]
    say("| scene | asked s | took s | steps | Gaussians | degree | MB | PSNR / SSIM | "
        "deviation | seeds |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for minutes in asked.minutes or [1.0]:
        for workspace in asked.workspaces:
            copy = asked.out / workspace.name
            if not copy.exists():
                shutil.copytree(workspace, copy)
            runs = [trained(copy, ["--minutes", str(minutes), "--seed", str(seed), *more])
                    for seed in range(asked.seeds)]
            say(row(workspace.name, minutes, runs))


if __name__ == "__main__":
    main()
