"""Renders of Gaussians as arrays, and what each Gaussian contributes to views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.config.stages import ComputeConfig
from recon_cli.context import StageContext
from recon_cli.errors import InputError
from recon_cli.io.images import to_uint8
from recon_cli.pipeline.execute import render_context
from recon_cli.progress import NullProgress
from recon_cli.render import registry
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.importance import Importance, add_views


@dataclass(frozen=True, eq=False)
class Rendering:
    """One view of a scene."""

    rgb: NDArray[np.float32]  # [H, W, 3] over the background; 0 to 1, but not clamped
    alpha: NDArray[np.float32]  # [H, W] coverage, 0 to 1
    # [H, W] expected z-depth in world units, 0 where alpha is 0. The mean of all that lies along a
    # ray: what shines through from far behind pulls it back; `render_depth` is that of the surface
    depth: NDArray[np.float32]

    @property
    def image(self) -> NDArray[np.uint8]:
        """The colours as a picture file holds them, [H, W, 3]."""
        return to_uint8(self.rgb)


@dataclass(frozen=True, eq=False)
class Contributions:
    """What each of N Gaussians contributes to some views; scores for pruning are made of it."""

    hits: NDArray[np.int64]  # [N] pixels that it is drawn in
    blend_max: NDArray[np.float64]  # [N] its greatest weight in a pixel, alpha T
    loo: NDArray[np.float64]  # [N] squared error that removing it alone causes, over all views
    views: int


def render(
    splats: Splats, camera: Camera, *, background: Sequence[float] | None = None,
    sh_degree: int | None = None, backend: str = "auto", device: str = "auto",
    threads: int | None = None,
) -> Rendering:
    """Returns a view of a scene, without gradients (`recon_cli.rasterization` has them).

    Args:
        splats: the Gaussians.
        camera: of `make_camera`, `look_at` or `read_cameras`.
        background: RGB behind all Gaussians; None for the colour of the scene's own backdrop,
            black where it has none.
        sh_degree: highest degree in use; None for all that the scene has.
        backend: auto, numba, triton or torch, as --backend. On a CPU the first call on a machine
            compiles numba's kernels, about a minute.
        device: auto, cpu, cuda or cuda:N.
        threads: on the CPU; None for all cores.

    Raises:
        BackendError: a backend or device that was named is not available.
        ConfigError: backend, device or threads is none.
        InputError: background or degree does not fit.
    """
    degree = _check_degree(sh_degree, splats)
    color = splats.background if background is None else _check_color(background, splats)
    with computing(backend, device, threads) as ctx, torch.no_grad():
        output = registry.render(
            _placed(splats, ctx), camera, color.to(ctx.device, torch.float32), degree,
            backend=ctx.backend)
        expected = output.depth / output.alpha.clamp_min(1e-10)
        rgb, alpha, depth = (
            np.array(tensor.cpu().numpy(), np.float32)
            for tensor in (output.rgb, output.alpha, expected))
        return Rendering(rgb, alpha, depth)


def render_depth(
    splats: Splats, camera: Camera, *, backend: str = "auto", device: str = "auto",
    threads: int | None = None,
) -> NDArray[np.float32]:
    """Returns the z-depth of the surface in a view, [H, W] in world units; 0 where there is none.

    It is where the Gaussian at which half of the light is stopped is densest along the ray of a
    pixel, as for meshes and measures. Arguments and errors are those of `render`.
    """
    with computing(backend, device, threads) as ctx:
        depth = render_surface(_placed(splats, ctx), camera, backend=ctx.backend).depth
        return np.array(depth.cpu().numpy(), np.float32)


def measure_contributions(
    splats: Splats, cameras: Sequence[Camera], *,
    masks: Sequence[NDArray[np.bool_] | None] | None = None, sh_degree: int | None = None,
    backend: str = "auto", device: str = "auto", threads: int | None = None,
) -> Contributions:
    """Returns what each Gaussian contributes to the views of some cameras, as `recon prune` does.

    `masks` are [H, W], True where a pixel counts, one for each camera or None. The other arguments
    and errors are those of `render`. Give training views, never those that scores are taken on.
    """
    degree = _check_degree(sh_degree, splats)
    masks = [None] * len(cameras) if masks is None else masks
    if len(masks) != len(cameras):
        raise InputError(f"There are {len(masks)} masks for {len(cameras)} cameras.",
                         hint="Give one for each camera, None where all pixels count.")
    views = [_blank_view(camera, mask) for camera, mask in zip(cameras, masks, strict=True)]
    with computing(backend, device, threads) as ctx:
        found = Importance.zeros(len(splats), torch.device(ctx.device))
        add_views(found, _placed(splats, ctx), views, sh_degree=degree, backend=ctx.backend)
        hits, blend_max, loo = (
            tensor.cpu().numpy() for tensor in (found.hits, found.blend_max, found.loo))
        return Contributions(hits, blend_max, loo, found.views)


def _placed(splats: Splats, ctx: StageContext) -> Splats:
    return splats.map(lambda tensor: tensor.detach().to(ctx.device, torch.float32))


def _blank_view(camera: Camera, mask: NDArray[np.bool_] | None) -> TrainView:
    size = (camera.height, camera.width)
    if mask is not None and (mask.shape != size or mask.dtype != np.bool_):
        raise InputError(f"A mask is {mask.shape} of {mask.dtype}, needed {size} of bool.",
                         hint="Give one of the size of its camera: mask > 0.")
    return TrainView(camera, np.broadcast_to(np.uint8(0), (*size, 3)), mask)


def _check_degree(degree: int | None, splats: Splats) -> int:
    if degree is None:
        return splats.sh_degree
    if degree not in range(4):
        raise InputError(f"sh_degree is {degree}, needed 0 to 3.", hint="Leave it out for all.")
    return degree


def _check_color(background: Sequence[float], splats: Splats) -> torch.Tensor:
    color = splats.means.new_tensor(np.asarray(background, np.float64))
    if tuple(color.shape) != (3,) or not bool(torch.isfinite(color).all()):
        raise InputError(f"background is {background!r}, needed three finite numbers.",
                         hint="White is (1, 1, 1).")
    return color


@contextmanager
def computing(backend: str, device: str, threads: int | None) -> Iterator[StageContext]:
    """Yields where to render, once ready; torch has its own number of threads again afterwards."""
    with keeping_threads():
        ctx = _context(backend, device, threads)
        registry.use_threads(ctx.backend, ctx.threads)
        yield ctx


@contextmanager
def keeping_threads() -> Iterator[None]:
    """Gives torch the number of threads again that it had before the block."""
    before = torch.get_num_threads()
    try:
        yield
    finally:
        if torch.get_num_threads() != before:
            torch.set_num_threads(before)


@cache  # it reads files, and logs what it chose
def _context(backend: str, device: str, threads: int | None) -> StageContext:
    return render_context(
        ComputeConfig(backend=backend, device=device, threads=threads), NullProgress())
