"""How much each Gaussian matters to the training views.

What the rasterizer finds in a pass is summed over the views, and every score is read off the sums.
Training steps leave the same statistics, so that scores need no pass of their own there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render import Statistics, render
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView

# Beside the scores that `recon prune` offers: what each of them has to beat.
RANDOM = "random"
_PERCENTILE = 0.9  # the volume at the ascending 90th percentile (equation 5)


@dataclass(eq=False)
class Importance:
    """Statistics of N Gaussians, added up over the training views; see `Statistics`."""

    hits: Tensor  # [N] int64, pixels that the Gaussian contributes to
    blend_max: Tensor  # [N] float64, greatest alpha T
    loo: Tensor  # [N] float64, squared error that removing it alone causes
    views: int = 0  # how many were added
    weighs: bool = True  # hits and blend weights are gathered
    leaves_out: bool = True  # loo is gathered

    @staticmethod
    def zeros(n: int, device: torch.device) -> Importance:
        """Returns the record of no view, for every score."""
        zeros = torch.zeros(n, dtype=torch.float64, device=device)
        return Importance(
            torch.zeros(n, dtype=torch.int64, device=device), zeros, zeros.clone())

    @staticmethod
    def of_score(name: str, n: int, device: torch.device) -> Importance:
        """Returns the record of no view that gathers no more than one score needs."""
        importance = Importance.zeros(n, device)
        importance.leaves_out = name == "loo"
        importance.weighs = name in ("paper", "blend_max")
        return importance

    @property
    def needs_views(self) -> bool:
        """Whether the score depends on the views at all."""
        return self.weighs or self.leaves_out

    def add(self, statistics: Statistics) -> None:
        """Adds the statistics of one view, as far as they are gathered."""
        self.views += 1
        if self.weighs:
            self.hits += statistics.hits
            self.blend_max = torch.maximum(self.blend_max, statistics.blend_max.double())
        if self.leaves_out:
            self.loo += statistics.loo

    def score(
        self, name: str, splats: Splats, *, beta: float, generator: torch.Generator
    ) -> Tensor:
        """Returns the score [N] float64 by which Gaussians are ranked; the lowest go first."""
        if name == "paper":
            return paper_score(self.hits, splats, beta)
        if name == RANDOM:
            drawn = torch.rand(len(splats), generator=generator, dtype=torch.float64)
            return drawn.to(splats.means.device)
        return {"blend_max": self.blend_max, "loo": self.loo}[name]


def paper_score(hits: Tensor, splats: Splats, beta: float) -> Tensor:
    """Returns the significance GS_j = hits_j sigma_j gamma(Sigma_j), [N] float64.

    ("3D Reconstruction of Indoor Scenes Based on 3DGS Models", equations 3 to 5; the form is
    LightGaussian's.) The indicator of equation 3, summed over all pixels of all training views,
    is the count of hits. gamma = V_norm^beta with V_norm = min(max(V / V_max90, 0), 1).
    """
    log_volumes = _log_volumes(splats)
    rank = math.ceil(_PERCENTILE * len(splats)) - 1
    reference = log_volumes.sort().values[rank]
    gamma = torch.exp(beta * (log_volumes - reference).clamp_max(0))
    return hits.double() * splats.opacities.detach().double() * gamma


def _log_volumes(splats: Splats) -> Tensor:
    """Returns the log of the product of the scales, [N] float64; the product may underflow."""
    return splats.log_scales.detach().double().sum(-1)


def add_views(
    found: Importance, splats: Splats, views: Iterable[TrainView], *, sh_degree: int, backend: str
) -> None:
    """Adds the statistics of a pass over views with their masks; never give it held-out views."""
    device = splats.means.device
    leaves = splats.map(lambda tensor: tensor.detach().requires_grad_(found.leaves_out))
    for view in views:
        output = render(leaves, view.camera, leaves.background, sh_degree, backend=backend,
                        scores=True, mask=view.counting(device))
        if output.rgb.requires_grad:
            output.rgb.sum().backward()  # type: ignore[no-untyped-call]
        found.add(output.statistics)
