"""What training steps record for densification, summed over views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.context import ProcessGroup
from recon_cli.render import Statistics


@dataclass(eq=False)
class DensificationStats:
    """How the loss pulled at each Gaussian since the last densification.

    Attributes:
        pull: [N] sum over steps of the length of the projected mean's gradient, in normalised
            device coordinates.
        count: [N] steps in which the Gaussian was seen.
        radius: [N] largest radius on the screen, pixels.
        variance: [N] sum over steps of sum ds^2 - (sum ds)^2 / n over the n pixels of the
            Gaussian, with ds = o dL/do: how much its pixels disagree about what it should be.
    """

    pull: Tensor
    count: Tensor
    radius: Tensor
    variance: Tensor

    @staticmethod
    def zeros(n: int, device: torch.device) -> DensificationStats:
        """Returns a record of nothing for n Gaussians."""
        return DensificationStats(*(torch.zeros(n, device=device) for _ in range(4)))

    def add(self, statistics: Statistics, width: int, height: int) -> None:
        """Adds what one backward pass over an image of width x height found."""
        # numbers and not a tensor of them: a copy to a GPU would wait for it
        across, down = statistics.means2d_grad.unbind(-1)
        self.pull += torch.stack((across * (width / 2), down * (height / 2)), -1).norm(dim=-1)
        self.count += statistics.radii > 0
        self.radius = torch.maximum(self.radius, statistics.radii)
        self.variance += statistics.variance

    def over(self, ranks: ProcessGroup) -> None:
        """Takes together what the processes found that train together."""
        ranks.add([self.pull, self.count, self.variance])
        ranks.all_reduce_max(self.radius)

    def times(self, factor: Tensor) -> DensificationStats:
        """Returns all of it times a factor, a number on the device."""
        return DensificationStats(*(value * factor for value in vars(self).values()))

    def join(self, other: DensificationStats) -> None:
        """Adds what was found elsewhere."""
        self.pull += other.pull
        self.count += other.count
        self.radius = torch.maximum(self.radius, other.radius)
        self.variance += other.variance

    @property
    def mean_grad2d(self) -> Tensor:
        """Mean length per step in which the Gaussian was seen, [N]; 0 where it never was."""
        return self.pull / self.count.clamp_min(1)
