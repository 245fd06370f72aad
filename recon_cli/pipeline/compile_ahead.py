"""Compiles the kernels for this CPU in a process beside the stages that come before training."""

from __future__ import annotations

import importlib.util
import logging
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from recon_cli import machine
from recon_cli.pipeline.execute import Job

_SOURCES = Path(__file__).parents[1] / "render" / "numba"
_KILL_SECONDS = 10.0
_LOG_TAIL = 2000  # characters

logger = logging.getLogger("recon")


@contextmanager
def compile_ahead(job: Job, stages: Sequence[str], *, again: bool) -> Iterator[None]:
    """Compiles while `stages` run, if others come before the first one that renders.

    A stage that needs the kernels waits for the process by the lock of their folder, and compiles
    them itself where that one failed. A failure is logged, for it costs nothing but time.
    """
    if not _waits(job, stages, again=again):
        yield
        return
    command = [sys.executable, "-m", "recon_cli.render.compile_worker", job.compute.backend,
               job.compute.device]
    # In the workspace: `python -m` looks for modules in the current folder first.
    with tempfile.TemporaryFile() as log, subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=job.workspace.root,
    ) as child:
        try:
            yield
        finally:
            code = child.poll()
            child.kill()
            child.wait(_KILL_SECONDS)
            if code:
                log.seek(0)
                logger.debug("the process that compiles kernels ended with %d: %s", code,
                             log.read().decode(errors="replace")[-_LOG_TAIL:])


def _compiled_since_installed() -> bool:
    """Returns whether kernels were compiled after their sources and numba were installed.

    A hint, for numba alone, whose import takes a second, knows what it is going to compile: where
    it misleads, kernels are compiled when they are needed.
    """
    numba = importlib.util.find_spec("numba")
    sources = [*_SOURCES.glob("*.py"), *([Path(numba.origin)] if numba and numba.origin else [])]
    installed = max(path.stat().st_ctime for path in sources)
    return any(mark.stat().st_mtime > installed
               for mark in (machine.cache_root() / "kernels").glob("*/ready"))


def _waits(job: Job, stages: Sequence[str], *, again: bool) -> bool:
    """Returns whether the first stage that renders must wait for others."""
    if job.compute.backend not in ("auto", "numba") or job.compute.device == "cuda":
        return False
    if _compiled_since_installed():
        return False
    first = next((row for row in job.table if row.renders and row.name in stages), None)
    if first is None:
        return False
    return any(
        (again and row.name in stages) or not job.workspace.folder(row.name).exists()
        for row in job.table if not row.renders and row.name in (*stages, *first.needs))
