"""The numba backend behind the contract: float32 on the CPU, differentiable by autograd.

Its kernels are loaded from the cache, or compiled under a progress bar, before the first use.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from recon_cli.machine import POLL_SECONDS
from recon_cli.render.contract import (
    RenderOutput, Statistics, StepOptions, TargetImage)
from recon_cli.kernels.kernel import CODE, READY, cache_folder, unsaved, without_scipy
from recon_cli.kernels.kernel import is_warm as is_warm
from recon_cli.render.numba.optimizer import step
from recon_cli.render.numba.step import PhotometricStep
from recon_cli.kernels.thread_pool import pool
from recon_cli.render.numba.view_pass import (
    ImageBuffers, Lease, PackedSplats, RenderSettings, flat)
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

KERNELS = 12  # that threads share; the progress counts these


def render(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
    mask: Tensor | None = None,
) -> RenderOutput:
    """Renders by the contract; see `recon_cli.render.registry.render`.

    Raises ValueError unless the splats are float32 on the CPU.
    """
    _check(splats)
    statistics = Statistics.zeros(splats.means)
    tensors = list(splats.parameters().values())
    if min(sh_degree, splats.sh_degree) == 0:
        tensors[5] = tensors[5].detach()  # not used by the image
    settings = RenderSettings(
        flat(background).copy(), sh_degree, scores,
        None if mask is None else mask.contiguous().numpy())
    rgb, alpha, depth = _Render.apply(background, camera, settings, statistics, *tensors)
    return RenderOutput(rgb, alpha, depth, statistics)


def find_crossing(splats: Splats, camera: Camera, level: float) -> Tensor:
    """Returns which Gaussian brings T down to a level; see `registry.find_crossing`."""
    _check(splats)
    lease = Lease()
    rows = torch.empty(camera.height, camera.width, dtype=torch.int32)
    lease.view_pass.crossing(
        PackedSplats.from_tensors(splats.parameters().values()), camera,
        level, rows.view(-1).numpy(), Statistics.zeros(splats.means.detach()))
    return rows.long()


def _check(splats: Splats) -> None:
    if splats.means.dtype != torch.float32 or splats.means.device.type != "cpu":
        raise ValueError(
            f"the numba backend takes float32 on the CPU, not {splats.means.dtype} on "
            f"{splats.means.device}; the torch backend takes both")


class _Render(torch.autograd.Function):
    """All kernels of a view as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any, background: Tensor, camera: Camera, settings: RenderSettings,
        statistics: Statistics, *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.set_materialize_grads(False)  # a loss of colours alone takes less
        size = camera.height, camera.width
        rgb, alpha, depth = (background.new_empty(*size, 3), background.new_empty(size),
                             background.new_empty(size))
        lease = Lease()
        lease.view_pass.forward(
            PackedSplats.from_tensors(tensors), camera, settings,
            ImageBuffers(flat(rgb), flat(alpha), flat(depth)), statistics)
        ctx.save_for_backward(*tensors)
        ctx.lease, ctx.statistics, ctx.scores = lease, statistics, settings.scores
        # the output itself would hold its own graph, and with it the lease, for ever
        ctx.alpha = alpha.detach()
        return rgb, alpha, depth

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor | None, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        tensors, nothing = ctx.saved_tensors, np.empty(0, np.float32)
        grad_rgb = ctx.alpha.new_zeros(*ctx.alpha.shape, 3) if grad_rgb is None else grad_rgb
        gradients = [torch.empty_like(tensor, memory_format=torch.contiguous_format)
                     for tensor in tensors]
        ctx.lease.view_pass.backward(
            PackedSplats.from_tensors(tensors), PackedSplats.from_tensors(gradients),
            ImageBuffers(flat(grad_rgb), *(nothing if gradient is None else flat(gradient)
                                           for gradient in (grad_alpha, grad_depth))),
            ctx.statistics, loo=ctx.scores)
        if ctx.statistics.keep_ellipses:
            ctx.statistics.ellipses = ctx.lease.view_pass.ellipse_gradients()
        grad_background = None
        if ctx.needs_input_grad[0]:
            grad_background = (grad_rgb * (1 - ctx.alpha)[..., None]).sum((0, 1))
        return (grad_background, None, None, None, *gradients)


def warm_up(on_kernel: Callable[[], None] = lambda: None) -> float:
    """Loads or compiles every kernel by running a tiny scene, and returns the seconds it took.

    `on_kernel` is called after each of the KERNELS kernels is ready. Where another process compiles
    them, this one waits until it is done, or gone.
    """
    start = time.perf_counter()
    ready: set[str] = set()
    counted = 0

    def count(kernels: int) -> None:
        nonlocal counted
        for _ in range(counted, min(kernels, KERNELS)):
            counted += 1
            on_kernel()

    def observe(name: str, _seconds: float) -> None:
        ready.add(name)
        count(len(ready))

    folder = cache_folder()
    before, pool.observer = pool.observer, observe
    try:
        with without_scipy():
            if folder is None or is_warm():
                _run_all()
            else:
                with _writing(folder, lambda: count(len([*folder.rglob(f"*{CODE}")]))):
                    _run_all()
                    if not unsaved:
                        (folder / READY).touch()
    finally:
        pool.observer = before
    return time.perf_counter() - start


@contextmanager
def _writing(folder: Path, on_wait: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Holds the lock of a folder: two processes would compile the same.

    Calls `on_wait` now and then while another process holds it.
    """
    lock = FileLock(folder.with_suffix(".lock"))
    while True:
        try:
            lock.acquire(timeout=POLL_SECONDS)
            break
        except Timeout:
            on_wait()
    try:
        yield
    finally:
        lock.release()


def _run_all() -> None:
    """Runs every kernel once, on three Gaussians and an image of 20x20 pixels."""
    n = 3
    splats = Splats(
        means=torch.tensor([[0.0, 0.0, 2.0]] * n), quats=torch.tensor([[1.0, 0, 0, 0]] * n),
        log_scales=torch.full((n, 3), -2.0), logit_opacities=torch.zeros(n),
        sh_dc=torch.zeros(n, 3), sh_rest=torch.zeros(n, 15, 3))
    camera = Camera(20, 20, 20.0, 20.0, 10.0, 10.0, np.eye(4))
    gradients = splats.map(torch.zeros_like)
    photograph = TargetImage(np.zeros((20, 20, 3), np.uint8))
    PhotometricStep()(splats, gradients, camera, photograph, StepOptions(3, 0.2))
    render(splats, camera, torch.zeros(3), 3, scores=True)
    find_crossing(splats, camera, 0.5)
    groups = [tensor.reshape(-1) for tensor in gradients.parameters().values()]
    step(groups, groups, (groups, groups), [0.0] * len(groups), count=1, betas=(0.9, 0.999),
         epsilon=1e-15)
