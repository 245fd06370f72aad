"""Which Gaussians need colours that depend on the direction, and which do with one colour.

After Papantonakis et al. 2024, "Reducing the Memory Footprint of 3D Gaussian Splatting": what
looks the same from all training views loses its higher spherical harmonics and takes the mean of
what was seen. Left out is their second step, degrees between: here a Gaussian has the scene's
degree or none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon_cli.render.torch.projection import colors_from_sh, project
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0, Splats

# Deviation of a colour in [0, 1] under which it counts as one: --std_threshold of the paper's runs
# ("full_final" in the authors' full_eval.py), taken there at 15,000 of 30,000 iterations.
UNIFORM = 0.04


@dataclass(frozen=True, eq=False)
class ColorSpread:
    """What the training views see of each Gaussian's colour, weighted by how much they see.

    Attributes:
        mean: [N, 3] weighted mean, at least 0; the base colour where no view sees the Gaussian.
        deviation: [N] weighted standard deviation of a channel, mean over the channels; 0 where no
            view sees the Gaussian.
    """

    mean: Tensor
    deviation: Tensor


def visibility(splats: Splats, cameras: Iterable[Camera]) -> Iterator[Tensor]:
    """Yields for each camera the weights [N]: 1 where a Gaussian may touch the image, else 0."""
    for camera in cameras:
        weights = splats.means.new_zeros(len(splats))
        with torch.no_grad():
            weights[project(splats, camera, 0).ids] = 1
        yield weights


@torch.no_grad()
def color_spread(
    splats: Splats, cameras: Iterable[Camera], weights: Iterable[Tensor]
) -> ColorSpread:
    """Returns mean and deviation of the colours towards the cameras.

    In one pass and without cancellation (West 1979, "Updating Mean and Variance Estimates").

    Args:
        splats: N Gaussians.
        cameras: V training views.
        weights: for each camera [N] how much it sees of each Gaussian, at least 0: the mean
            transmittance in front of it (the paper), a count of pixels, or `visibility`. A tensor
            [V, N] will do.
    """
    total = torch.zeros(len(splats), dtype=torch.float64, device=splats.means.device)
    mean = (SH_C0 * splats.sh_dc + 0.5).clamp_min(0).double()
    squares = torch.zeros_like(mean)
    for camera, weight in zip(cameras, weights, strict=True):
        seen = torch.nonzero(weight > 0)[:, 0]
        share = weight[seen].double()
        total[seen] += share
        part = (share / total[seen])[:, None]  # 1 the first time: what was there before goes
        away = _colors(splats, seen, camera).double() - mean[seen]
        mean[seen] += part * away
        squares[seen] += share[:, None] * (1 - part) * away.square()
    variance = squares / total.clamp_min(torch.finfo(torch.float64).tiny)[:, None]
    return ColorSpread(mean.to(splats.means.dtype), variance.sqrt().mean(-1).to(splats.means.dtype))


def _colors(splats: Splats, ids: Tensor, camera: Camera) -> Tensor:
    """Returns the colours [K, 3] of some Gaussians towards a camera."""
    center = torch.as_tensor(camera.center, dtype=splats.means.dtype, device=splats.means.device)
    return colors_from_sh(
        splats.means[ids] - center, splats.sh_dc[ids], splats.sh_rest, ids, splats.sh_degree)


def needed(spread: ColorSpread, *, threshold: float = UNIFORM) -> Tensor:
    """Returns a mask [N]: the colour differs between training views, and needs higher degrees."""
    return spread.deviation >= threshold


@torch.no_grad()
def reduced(
    splats: Splats, keep: Tensor, *, colors: Tensor | None = None
) -> tuple[Splats, Tensor]:
    """Returns splats of which only some keep their higher harmonics; these come first.

    Args:
        splats: N Gaussians.
        keep: [N] mask of those that keep what they have; who has none gets none.
        colors: [N, 3] what those that lose theirs look like from now on, as of `ColorSpread`; None
            leaves them their base colour.

    Returns:
        N Gaussians, detached, and the old row [N] of each: what `SplatOptimizer.replace` takes.
    """
    colored = torch.arange(len(splats), device=keep.device) < len(splats.sh_rest)
    kept = keep & colored
    order = torch.cat([torch.nonzero(kept)[:, 0], torch.nonzero(~kept)[:, 0]])
    if colors is not None:
        plain = ((colors - 0.5) / SH_C0).to(splats.sh_dc)
        splats = replace(
            splats, sh_dc=torch.where((colored & ~keep)[:, None], plain, splats.sh_dc))
    few = replace(splats, sh_rest=splats.sh_rest[:0]).select(order)
    rest = splats.sh_rest.detach()[kept[: len(splats.sh_rest)]]
    return replace(few, sh_rest=rest), order
