"""How much each Gaussian matters to the training views, and which ones go."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from recon_cli.render import Statistics, render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

_PERCENTILE = 0.9  # the volume at the ascending 90th percentile (equation 5)


def paper_score(hits: Tensor, splats: Splats, beta: float) -> Tensor:
    """Returns the significance GS_j = hits_j sigma_j gamma(Sigma_j), [N] float64.

    ("3D Reconstruction of Indoor Scenes Based on 3DGS Models", equations 3 to 5; the form is
    LightGaussian's.) The indicator of equation 3, summed over all pixels of all training views,
    is the count of hits. gamma = V_norm^beta with V_norm = min(max(V / V_max90, 0), 1).

    Args:
        hits: [N] pixels over all training views that each Gaussian contributes to.
        splats: N Gaussians.
        beta: exponent of the volume.
    """
    # in log space: the product of three scales of 1e-15 leaves the range of float32
    log_volumes = splats.log_scales.detach().double().sum(-1)
    rank = math.ceil(_PERCENTILE * len(splats)) - 1
    reference = log_volumes.sort().values[rank]
    gamma = torch.exp(beta * (log_volumes - reference).clamp_max(0))
    return hits.double() * splats.opacities.detach().double() * gamma


def significance(
    name: str,
    splats: Splats,
    cameras: Iterable[Camera],
    *,
    beta: float,
    sh_degree: int,
    backend: str,
    generator: torch.Generator,
) -> Tensor:
    """Returns the score [N] by which Gaussians are ranked; the lowest go first.

    Masks are left out: hits, blend weights and leave-one-out errors come from the rasterizer, which
    knows no masks, so pixels that training ignores count here like any other.

    Args:
        name: paper, blend_max, loo, opacity or random.
        splats: N Gaussians.
        cameras: training views at their training size; never validation or test views.
        beta: exponent of the volume in the paper's score.
        sh_degree: degree in use.
        backend: rasterizer that counts hits and blend weights while it renders.
        generator: draws the random score.
    """
    if name == "opacity":
        return splats.opacities.detach().double()
    if name == "random":
        return torch.rand(len(splats), generator=generator, dtype=torch.float64).to(
            splats.means.device)
    total = Statistics.zeros(splats.means.detach().double())
    background = torch.zeros(3, dtype=splats.means.dtype, device=splats.means.device)
    leaves = splats.map(lambda tensor: tensor.detach().requires_grad_(name == "loo"))
    for camera in cameras:
        output = render(leaves, camera, background, sh_degree, backend=backend, scores=True)
        if name == "loo" and output.rgb.requires_grad:
            output.rgb.sum().backward()  # type: ignore[no-untyped-call]
        total.hits += output.statistics.hits
        total.blend_max = torch.maximum(total.blend_max, output.statistics.blend_max.double())
        total.loo += output.statistics.loo
    if name == "paper":
        return paper_score(total.hits, splats, beta)
    return total.blend_max if name == "blend_max" else total.loo


def kept_rows(score: Tensor, ratio: float) -> Tensor:
    """Returns the rows [K] that stay, ascending, when a share of `ratio` is removed by rank.

    By rank and not by threshold: equal scores would otherwise all go at once. Of equal scores
    the later rows go first. At least one Gaussian stays.
    """
    n = len(score)
    count = max(1, n - int(ratio * n))
    order = torch.argsort(score, descending=True, stable=True)
    return order[:count].sort().values
