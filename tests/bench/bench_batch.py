"""Reconstructs 20 captures by `recon batch`, three of them broken; times Ray against processes.

`python bench_batch.py CAPTURE OUT`: CAPTURE is given 17 times under other names, to a batch that
is killed with -9 after a few scenes and called again. Then the first four are done anew, by
processes and on a Ray cluster of this machine in turns, two at a time with a core each.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

GOOD, AT_ONCE, TIMED = 17, 2, 4


def say(line: str) -> None:
    """Writes a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def make_inputs(capture: Path, folder: Path) -> list[Path]:
    """Returns the captures, after three that are broken: no video, one photo, no folder."""
    folder.mkdir(parents=True)
    torn, lonely = folder / "torn.mp4", folder / "lonely"
    torn.write_bytes(b"\0" * 10_000)
    lonely.mkdir()
    (lonely / "photo.jpg").write_bytes(b"no picture")
    inputs = [torn, lonely, folder / "missing.mp4"]
    for number in range(GOOD):
        path = folder / f"room{number:02d}{capture.suffix if capture.is_file() else ''}"
        path.symlink_to(capture.absolute())
        inputs.append(path)
    return inputs


def command(inputs: list[Path], out: Path, settings: list[str], *more: str) -> list[str]:
    """Returns a call of `recon batch`."""
    return [sys.executable, "-m", "recon_cli", "batch", *map(str, inputs), "--out", str(out),
            "--jobs", str(AT_ONCE), "--threads", "1", *more,
            *(word for text in settings for word in ("--set", text))]


def ended(out: Path) -> int:
    """Counts the captures of which batch.json knows the end."""
    path = out / "batch.json"
    if not path.exists():
        return 0
    rows = json.loads(path.read_text(encoding="utf-8"))["captures"]
    return sum(row["exit_code"] is not None for row in rows)


def main() -> None:
    """Prints the table of the batch and the ratios of the seconds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    given = parser.parse_args()
    inputs = make_inputs(given.capture, given.out / "inputs")
    words = command(inputs, given.out / "batch", given.settings)
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while ended(given.out / "batch") < 8 and process.poll() is None:
            time.sleep(0.2)
        process.send_signal(signal.SIGKILL)
    say(f"killed with {ended(given.out / 'batch')} of {len(inputs)} at their end; again:")
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    say(f"{run.stdout}{run.stderr.rpartition('error: ')[2]}exit code {run.returncode}")
    seconds: dict[str, list[float]] = {"local": [], "ray": []}
    for _ in range(given.rounds):
        for place, times in seconds.items():
            shutil.rmtree(given.out / place, ignore_errors=True)
            begin = time.monotonic()
            subprocess.run(
                command(inputs[3 : 3 + TIMED], given.out / place, given.settings, "--on", place),
                check=True, capture_output=True)
            times.append(time.monotonic() - begin)
            say(f"{place}: {TIMED} captures, {AT_ONCE} at once, in {times[-1]:.1f} s")
    ratios = [ray / local for local, ray in zip(*seconds.values(), strict=True)]
    say(f"Ray over local: {', '.join(f'{ratio:.3f}' for ratio in ratios)}, "
        f"median {statistics.median(ratios):.3f}")


if __name__ == "__main__":
    main()
