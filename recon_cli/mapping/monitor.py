"""How far the mapping process is: from what it says, and from what lies on the disk.

COLMAP calls nobody back while it extracts, matches and undistorts, but it writes each result as
soon as it has it. So the parent counts those.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack

from recon_cli.mapping import database, protocol
from recon_cli.mapping.job import Job
from recon_cli.progress import Bar, Progress

_DOING = {
    "features": ("finding features", "frame"),
    "matches": ("matching frames", "pair"),
    "mapping": ("placing cameras", "frame"),
    "undistorted": ("undistorting frames", "frame"),
}
_STEP = {"mapping": "model"}  # the step that a phase belongs to, where the names differ


class Monitor:
    """Shows one bar a phase and records what would survive a crash.

    Args:
        job: what the process does.
        progress: opens the bars.
        record: called with (done, total); each step counts as many units as there are frames.
    """

    def __init__(
        self, job: Job, progress: Progress, record: Callable[[int, int], None]
    ) -> None:
        self._job = job
        self._progress = progress
        self._record = record
        self._phase: protocol.Phase | None = None
        self._count = 0
        self._durable = 0
        self._bar: Bar | None = None
        self._open = ExitStack()

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *exc: object) -> None:
        self._open.close()

    @property
    def doing(self) -> str:
        """What the process is at, in words."""
        if self._phase is None:
            return "starting"
        text, unit = _DOING[self._phase.name]
        return f"{text} ({self._count} of {self._phase.total} {unit}s done)"

    def show(self, event: protocol.Event | None) -> None:
        """Takes notice of an event, or of what lies on the disk when there is none."""
        if isinstance(event, protocol.Phase):
            self._begin(event)
        elif isinstance(event, protocol.Done):
            self._reach(event.count)
        else:
            self._reach(self._counted())

    def _begin(self, phase: protocol.Phase) -> None:
        self._open.close()
        text, unit = _DOING[phase.name]
        self._phase, self._count = phase, phase.done
        self._bar = self._open.enter_context(
            self._progress.bar(text, phase.total, unit=unit, done=phase.done))
        self._note_durable()

    def _reach(self, count: int) -> None:
        if self._bar is not None and count > self._count:
            self._bar.advance(count - self._count)
            self._count = count
            self._note_durable()

    def _counted(self) -> int:
        """Returns how many results of the current phase lie on the disk."""
        phase = self._phase
        if phase is None:
            return 0
        if phase.name in ("features", "matches"):
            return database.progress(self._job.database, phase.name)
        if phase.name == "undistorted":
            # os.walk, not rglob: the process removes folders as it goes, and walk passes over them.
            files = sum(
                name.endswith(".png")
                for _, _, files in os.walk(self._job.undistorting) for name in files)
            return min(files, phase.total)  # masks lie there twice for a moment
        return 0

    def _note_durable(self) -> None:
        """Records finished steps, and images or pairs that the database keeps."""
        assert self._phase is not None
        frames, steps = len(self._job.names), self._job.steps
        step = steps.index(_STEP.get(self._phase.name, self._phase.name))
        kept = self._phase.name in ("features", "matches")
        share = min(1.0, self._count / max(1, self._phase.total)) if kept else 0.0
        # A further rung of the ladder matches again: what was reached before stays reached.
        self._durable = max(self._durable, round((step + share) * frames))
        self._record(self._durable, len(steps) * frames)
