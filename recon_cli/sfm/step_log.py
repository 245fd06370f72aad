"""Which sub-steps of mapping are finished, so that a killed run goes on where it stood.

A step counts as finished when it is written down here, and every file that it wrote still has the
size that was written down with it. A file alone proves nothing: it may be half of it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError
from recon_cli.workspace import atomic

STEPS = ("features", "matches", "model", "sparse", "undistorted")
FILE = "steps.json"

Result = dict[str, Any]  # JSON values only


class Ledger:
    """The finished steps in a folder; every change reaches the disk at once.

    Args:
        out: the stage's folder, or one in it.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._steps: dict[str, dict[str, Any]] = {}
        try:
            self._steps = dict(atomic.read_json(out / FILE))
        except FormatError:
            return  # the first run, or a disk that lost the file: every step is done again

    def result(self, step: str) -> Result | None:
        """Returns what `finish` noted for a step whose files are all there, else None."""
        entry = self._steps.get(step)
        if entry is None or any(
            not (self._out / name).is_file() or (self._out / name).stat().st_size != size
            for name, size in entry["files"].items()
        ):
            return None
        result: Result = entry["result"]
        return result

    def finish(self, step: str, result: Result, folder: Path | None = None) -> None:
        """Notes a step as finished, with its result and the files in the `folder` it wrote."""
        files = {
            path.relative_to(self._out).as_posix(): path.stat().st_size
            for path in (() if folder is None else _files(folder))
        }
        self._steps[step] = {"result": result, "files": files}
        atomic.write_json(self._out / FILE, self._steps)

    def forget_from(self, step: str) -> None:
        """Takes back a step and all that build on it."""
        for name in STEPS[STEPS.index(step):]:
            self._steps.pop(name, None)
        atomic.write_json(self._out / FILE, self._steps)


def publish(folder: Path, target: Path) -> None:
    """Moves a finished folder to its place, replacing what an interrupted run left there."""
    for path in _files(folder):
        with path.open("rb+") as file:
            os.fsync(file.fileno())
    if target.exists():
        shutil.rmtree(target)
    folder.rename(target)
    atomic.sync_folder(target.parent)


def fresh_folder(folder: Path) -> Path:
    """Returns `folder`, made anew and empty."""
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    return folder


def _files(folder: Path) -> Iterator[Path]:
    """Yields the files below a folder in a fixed order."""
    return (path for path in sorted(folder.rglob("*")) if path.is_file())
