"""Gets all kernels ready: from the cache, or compiled with something to look at meanwhile."""

from __future__ import annotations

import logging
import pickle
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from recon_cli.render.numba.backend import render
from recon_cli.render.numba.camera_gradient import pull_of_scene
from recon_cli.render.numba.kernel import cache_folder
from recon_cli.render.numba.optimizer import step
from recon_cli.render.numba.step import PhotometricStep
from recon_cli.render.numba.thread_pool import crew
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

logger = logging.getLogger("recon")

KERNELS = 12  # that threads share; the progress counts these
_SCIPY = "scipy.linalg"
_READY = "ready"  # file in the cache folder once every kernel is there
_DAMAGE = (pickle.UnpicklingError, EOFError, ImportError, AttributeError, IndexError, KeyError,
           ValueError, TypeError, RuntimeError)


def is_warm() -> bool:
    """Tells whether machine code for this CPU is there."""
    folder = cache_folder()
    return folder is not None and (folder / _READY).exists()


def warm_up(on_kernel: Callable[[], None] = lambda: None) -> float:
    """Loads or compiles every kernel by running a tiny scene, and returns the seconds it took.

    Args:
        on_kernel: called after each of the KERNELS kernels is ready.
    """
    start = time.perf_counter()
    seen: set[str] = set()

    def observe(name: str, _seconds: float) -> None:
        if name not in seen:
            seen.add(name)
            on_kernel()

    folder = cache_folder()
    # _READY may be missing although there are files: a crash can lose it and cut them short
    found = folder is not None and any(folder.rglob("*.nbi"))
    before, crew.observer = crew.observer, observe
    try:
        with _without_scipy():
            _run_all()
    except _DAMAGE:
        if folder is None or not found:
            raise
        logger.warning("the compiled kernels in %s cannot be read; compiling them again", folder)
        _clear(folder)
        _run_all()
    finally:
        crew.observer = before
    if folder is not None:
        (folder / _READY).touch()
    return time.perf_counter() - start


@contextmanager
def _without_scipy() -> Iterator[None]:
    """Keeps numba from importing scipy.linalg, which takes longer than loading all kernels.

    numba looks for BLAS there when it sets itself up; no kernel multiplies matrices with it.
    """
    if _SCIPY in sys.modules:
        yield
        return
    sys.modules[_SCIPY] = None  # type: ignore[assignment]  # an import of it fails at once
    try:
        yield
    finally:
        del sys.modules[_SCIPY]


def _clear(folder: Path) -> None:
    """Deletes what a folder holds; another process may be at it as well."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _run_all() -> None:
    """Runs every kernel once, on three Gaussians and an image of 20x20 pixels."""
    n = 3
    splats = Splats(
        means=torch.tensor([[0.0, 0.0, 2.0]] * n), quats=torch.tensor([[1.0, 0, 0, 0]] * n),
        log_scales=torch.full((n, 3), -2.0), logit_opacities=torch.zeros(n),
        sh_dc=torch.zeros(n, 3), sh_rest=torch.zeros(n, 15, 3))
    camera = Camera(20, 20, 20.0, 20.0, 10.0, 10.0, np.eye(4))
    gradients = splats.map(torch.zeros_like)
    PhotometricStep()(
        splats, gradients, camera, np.zeros((20, 20, 3), np.uint8), torch.zeros(3), 3, 0.2)
    pull_of_scene(splats, gradients, camera, 3)
    render(splats, camera, torch.zeros(3), 3, scores=True)
    flat = [tensor.reshape(-1) for tensor in gradients.parameters().values()]
    step(flat, flat, flat, flat, [0.0] * len(flat), count=1, betas=(0.9, 0.999), epsilon=1e-15)
