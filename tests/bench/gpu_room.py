"""From poses to full quality: runs of several lengths on a capture, scored on its held-out views.

Each run is `recon train` and `recon eval` in processes of their own, as a user would start them.
The longest run says what full quality is. Held-out views are only scored.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from gpu_figures import Figures, Goal

QUALITY, REACHED = Goal(60, 20), Goal(15, 5)  # seconds
_WITHIN_DB = 0.1
_MADE = "ingest", "denoise", "sfm"
_FAILED_LINES = 12


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes:
        steps: of training.
        train_seconds: of its steps alone.
        stage_seconds: trials, calibration, loading and saving included.
        psnr_db: mean over the held-out views.
        gaussians: at the end.
    """

    steps: int
    train_seconds: float
    stage_seconds: float
    psnr_db: float
    gaussians: int


class OutOfTimeError(Exception):
    """A process was ended because the deadline came."""


class Room:
    """A workspace of its own for one capture.

    Args:
        figures: where everything is told.
        workspace: made here.
        size: longest side of the images; None for what `recon train` takes.
    """

    def __init__(self, figures: Figures, workspace: Path, size: int | None) -> None:
        self._figures, self._workspace = figures, workspace
        self._size = [] if size is None else ["--max-size", str(size)]

    def prepare(self, folder: Path) -> None:
        """Takes over the cameras of a workspace, or makes one of a data set with poses."""
        if (folder / "sfm" / "manifest.json").exists():
            for stage in _MADE:
                shutil.copytree(folder / stage, self._workspace / stage)
            note = "made before"
        else:
            self._recon("ingest", str(folder))
            self._recon("sfm", "--poses", "keep")
            note = "ingest, denoise and sfm --poses keep"
        seconds = sum(self._manifest(stage)["seconds"] for stage in _MADE)
        self._figures.add("room: before training", seconds, "s", note=note)

    def trained(self, steps: int) -> Run:
        """Trains and scores."""
        device = ["--device", self._figures.device]
        self._recon("train", "--again", "--iterations", str(steps), "--no-early-stop", *self._size,
                    *device)
        self._recon("eval", *device)
        manifest = self._manifest("train")
        scores = json.loads((self._workspace / "evaluate" / "metrics.json").read_text())
        base = scores["models"]["base"]
        run = Run(steps, manifest["summary"]["train_seconds"], manifest["seconds"],
                  base["psnr_db"], base["gaussians"])
        self._figures.add(
            f"room: {steps:,} steps", run.train_seconds, "s",
            note=f"{run.psnr_db:.2f} dB, {run.gaussians:,} Gaussians; {run.stage_seconds:.1f} s "
                 f"with trials and calibration; {manifest['backend']}")
        return run

    def _manifest(self, stage: str) -> dict:
        return json.loads((self._workspace / stage / "manifest.json").read_text())

    def _recon(self, *words: str) -> None:
        command = [sys.executable, "-m", "recon_cli", *words, "-w", str(self._workspace)]
        try:
            done = subprocess.run(command, check=False, capture_output=True, text=True,
                                  timeout=max(1.0, self._figures.left))
        except subprocess.TimeoutExpired as error:
            raise OutOfTimeError(" ".join(words)) from error
        if done.returncode:
            said = "\n".join((done.stdout + done.stderr).splitlines()[-_FAILED_LINES:])
            raise RuntimeError(f"recon {' '.join(words)} ended with {done.returncode}:\n{said}")


def run(
    figures: Figures, folder: Path, steps: Sequence[int], size: int | None, reach: float | None
) -> None:
    """Trains runs of several lengths as time allows, and tells which are good enough.

    With `reach` that is the first of at least so many dB, from the shortest on. Else those are as
    good as the longest: the shortest comes first, because it says how long the others take, and the
    longest next.
    """
    shortest, *longer = sorted(set(steps))
    with tempfile.TemporaryDirectory(prefix="recon-gpu-") as scratch:
        room, runs = Room(figures, Path(scratch) / "workspace", size), []
        try:
            room.prepare(folder)
            for number in (shortest, *(longer if reach is not None else reversed(longer))):
                if runs and (needed := _estimate(runs, number)) > figures.left:
                    figures.say(f"{number:,} steps are left out: they take {needed:.0f} s or more, "
                                f"{max(0, figures.left):.0f} s are left")
                    continue
                runs.append(room.trained(number))
                if reach is not None and runs[-1].psnr_db >= reach:
                    break
        except OutOfTimeError as error:
            figures.say(f"the time was over during recon {error}")
    figures.more["room"] = [asdict(one) for one in runs]
    if reach is None:
        conclude(figures, runs, max(steps))
    else:
        _say_reached(figures, runs, reach)


def _say_reached(figures: Figures, runs: Sequence[Run], reach: float) -> None:
    """Tells the seconds of the last run, if it is good enough."""
    name = f"room: to {reach:g} dB"
    best = max((one.psnr_db for one in runs), default=-math.inf)
    if best < reach:
        figures.add(name, None, "s", REACHED, note=f"not reached: {best:.2f} dB")
        return
    figures.add(name, runs[-1].stage_seconds, "s", REACHED, note=(
        f"{runs[-1].steps:,} steps, {runs[-1].psnr_db:.2f} dB; {runs[-1].train_seconds:.1f} s "
        "without trials and calibration"))


def _estimate(runs: Sequence[Run], steps: int) -> float:
    """Returns the seconds that a run takes at the least, by those before it."""
    beside = min(one.stage_seconds - one.train_seconds for one in runs)
    return beside + runs[0].train_seconds * steps / runs[0].steps


def conclude(figures: Figures, runs: Sequence[Run], longest: int) -> None:
    """Tells the least seconds within a tenth of a dB of the longest run."""
    name = f"room: to within {_WITHIN_DB} dB of {longest:,} steps"
    best = next((one for one in runs if one.steps == longest), None)
    if best is None:
        figures.add(name, None, "s", QUALITY, note="no time for the longest run")
        return
    good = [one for one in runs if one.psnr_db >= best.psnr_db - _WITHIN_DB]
    least = min(good, key=lambda one: one.train_seconds)
    figures.add(name, least.train_seconds, "s", QUALITY, note=(
        f"{least.steps:,} steps, {least.psnr_db:.2f} dB of {best.psnr_db:.2f}; "
        f"{least.stage_seconds:.1f} s with trials and calibration"))
