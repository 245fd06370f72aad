"""Images of a scene that nobody differentiates: by the numba kernels without torch, or by torch."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.splat_arrays import Floats, SplatArrays

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats


@dataclass(frozen=True, eq=False)
class Drawing:
    """What a camera sees."""

    rgb: Floats  # [H, W, 3] on the backdrop, not clamped
    alpha: Floats  # [H, W]
    hits: int  # pixels that Gaussians contribute to, summed over these; 0 where not counted


@dataclass(eq=False)
class _Totals:
    """The statistics of `render.contract` that a forward pass writes, as arrays [N]."""

    radii: Floats
    hits: NDArray[np.int64]
    blend_sum: Floats
    blend_max: Floats
    broken: int = 0


def use_kernels(threads: int) -> bool:
    """Returns whether the kernels of numba are compiled; they run in so many threads then."""
    if not find_spec("numba"):
        return False
    from recon_cli.kernels.kernel import is_warm
    from recon_cli.kernels.thread_pool import pool

    pool.threads = threads
    return is_warm()


def draw(
    splats: Splats | SplatArrays, camera: Camera, sh_degree: int, *, backend: str, device: str,
    count: bool = False,
) -> Drawing:
    """Returns what a camera sees of a scene; errors are those of `render.registry.render`."""
    if backend == "numba":
        return _draw_with_numba(splats.as_arrays(), camera, sh_degree, count)
    import torch

    from recon_cli.render.registry import render

    there = splats.as_tensors().map(lambda tensor: tensor.to(device))
    with torch.no_grad():
        output = render(there, camera, there.background, sh_degree, backend=backend, scores=count)
    return Drawing(output.rgb.cpu().numpy(), output.alpha.cpu().numpy(),
                   int(output.statistics.hits.sum()))


def _draw_with_numba(
    splats: SplatArrays, camera: Camera, sh_degree: int, count: bool
) -> Drawing:
    from recon_cli.kernels.kernel import without_scipy
    from recon_cli.render.numba.view_pass import (
        ImageBuffers,
        Lease,
        PackedSplats,
        RenderSettings,
    )

    n, pixels = len(splats), camera.width * camera.height
    totals: Any = _Totals(np.zeros(n, np.float32), np.zeros(n, np.int64),
                          np.zeros(n, np.float32), np.zeros(n, np.float32))
    image = ImageBuffers(*(np.empty(size, np.float32) for size in (3 * pixels, pixels, pixels)))
    with without_scipy():
        Lease().view_pass.forward(
            PackedSplats.from_tensors(splats.parameters().values()), camera,
            RenderSettings(splats.background, sh_degree, scores=count), image, totals)
    size = camera.height, camera.width
    return Drawing(image.rgb.reshape(*size, 3), image.alpha.reshape(size), int(totals.hits.sum()))
