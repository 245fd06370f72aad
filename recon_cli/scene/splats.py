"""The Gaussians of a scene as raw parameters, and what the parameters stand for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814  # the constant basis function, 1 / (2 sqrt(pi))


@dataclass(eq=False)
class Splats:
    """N Gaussians in the raw parameters that are optimized and stored.

    Attributes:
        means: [N, 3] centres in world units.
        quats: [N, 4] rotations, wxyz, of any length; zeros stand for no rotation.
        log_scales: [N, 3] natural logarithm of the standard deviations along the own axes.
        logit_opacities: [N] opacity before the sigmoid.
        sh_dc: [N, 3] spherical-harmonics coefficients of degree 0; colour = SH_C0 * sh_dc + 0.5.
        sh_rest: [N, 15, 3] coefficients of degrees 1 to 3.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh_dc: Tensor
    sh_rest: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        shapes = {
            "means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,),
            "sh_dc": (n, 3), "sh_rest": (n, 15, 3),
        }
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, needed {shape}")
            if tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise ValueError(f"{name} differs from means in dtype or device")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def parameters(self) -> dict[str, Tensor]:
        """Returns the raw parameters by name, in declaration order; no copies."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def map(self, change: Callable[[Tensor], Tensor]) -> Splats:
        """Returns splats whose every parameter went through `change`."""
        return Splats(**{name: change(value) for name, value in self.parameters().items()})

    def select(self, rows: Tensor) -> Splats:
        """Returns the Gaussians at `rows` ([K] indices or [N] mask), detached."""
        return self.map(lambda tensor: tensor.detach()[rows])

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the own axes, [N, 3], world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities in (0, 1), [N]."""
        return torch.sigmoid(self.logit_opacities)
