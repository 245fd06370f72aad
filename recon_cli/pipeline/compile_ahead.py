"""Compiles the kernels for this CPU or GPU in a process beside the stages before training."""

from __future__ import annotations

import importlib.util
import logging
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from recon_cli import machine
from recon_cli.processes import start_module

if TYPE_CHECKING:
    from recon_cli.pipeline.execute import Job

_SOURCES = Path(__file__).parents[1]
_DRIVER = Path("/proc/driver/nvidia/version")  # of an NVIDIA GPU
_KILL_SECONDS = 10.0
_LOG_TAIL = 2000  # characters

logger = logging.getLogger("recon")


@contextmanager
def compile_ahead(job: Job, stages: Sequence[str], *, again: bool) -> Iterator[None]:
    """Compiles while `stages` run, if others come before the first one that renders.

    A stage that needs the kernels for this CPU waits for the process by the lock of their folder,
    and compiles them itself where that one failed. One that needs those for a GPU compiles what is
    not there yet. A failure is logged, for it costs nothing but time.
    """
    if not _waits(job, stages, again=again):
        yield
        return
    with tempfile.TemporaryFile() as log, start_module(
        "recon_cli.train.compile_worker", job.compute.backend, job.compute.device,
        folder=job.workspace.root, out=log, errors=log,
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


def _needs_kernels(backend: str, device: str) -> bool:
    """Returns whether kernels were not compiled since their sources and compiler were installed.

    A hint: only torch, whose import takes a second, knows whether it can use the GPU. Where the
    hint misleads, kernels are compiled when they are needed.
    """
    gpu = device != "cpu" and backend in ("auto", "triton") and _DRIVER.exists()
    cpu = not device.startswith("cuda") and backend in ("auto", "numba")
    if not gpu and not cpu:
        return False
    checked = gpu and _made_since_installed("self-check/triton-*.json", "triton")
    return not (checked or (cpu and _made_since_installed("kernels/*/ready", "numba")))


def _made_since_installed(marks: str, package: str) -> bool:
    """Returns whether one of the marks in the cache is newer than a backend's package."""
    found = importlib.util.find_spec(package)
    sources = [*_SOURCES.glob(f"render/{package}/*.py"), *_SOURCES.glob("kernels/*.py")]
    sources += [Path(found.origin)] if found and found.origin else []
    installed = max((path.stat().st_ctime for path in sources), default=0.0)
    return any(mark.stat().st_mtime > installed for mark in machine.cache_root().glob(marks))


def _waits(job: Job, stages: Sequence[str], *, again: bool) -> bool:
    """Returns whether the first stage that renders must wait for others."""
    if not _needs_kernels(job.compute.backend, job.compute.device):
        return False
    first = next((row for row in job.table if row.renders and row.name in stages), None)
    if first is None:
        return False
    return any(
        (again and row.name in stages) or not job.workspace.folder(row.name).exists()
        for row in job.table if not row.renders and row.name in (*stages, *first.needs))
