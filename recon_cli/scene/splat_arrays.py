"""Gaussians as arrays of numpy: what files hold, without torch, whose import takes seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.backdrop import SPHERE_OPACITY, Backdrop

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant basis function
EXTENT_SIGMAS = 3.0  # standard deviations of a Gaussian within which nearly all of it lies
LEAST_OPACITY = 1e-6  # far below 1/255, and its logit is finite in float32
MOST_OPACITY = 0.999  # likewise
TERMS = (0, 3, 8, 15)  # coefficients a channel after the constant one, by degree
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """N Gaussians in the raw parameters that `Splats` holds as tensors; float32."""

    means: Floats  # [N, 3]
    quats: Floats  # [N, 4] wxyz
    log_scales: Floats  # [N, 3]
    logit_opacities: Floats  # [N]
    sh_dc: Floats  # [N, 3]
    sh_rest: Floats  # [M, T, 3]
    backdrop: Backdrop | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.means)

    @staticmethod
    def from_parameters(
        parameters: Mapping[str, Floats], backdrop: Backdrop | None = None
    ) -> SplatArrays:
        """Returns Gaussians of the raw parameters by name."""
        return SplatArrays(*(parameters[item.name] for item in fields(SplatArrays)[:-1]),
                           backdrop=backdrop)

    def parameters(self) -> dict[str, Floats]:
        """Returns the raw parameters by name, in declaration order; no copies."""
        return {item.name: getattr(self, item.name) for item in fields(self)[:-1]}

    def first(self, count: int) -> SplatArrays:
        """Returns the first Gaussians."""
        return self._changed({name: value[:count] for name, value in self.parameters().items()})

    def with_sphere(self, largest: float = math.inf) -> SplatArrays:
        """Returns the Gaussians with their backdrop as Gaussians; see `Splats.with_sphere`."""
        if self.backdrop is None:
            return self
        positions, scale = self.backdrop.sphere(self.means, largest)
        opacity, color = np.float32(SPHERE_OPACITY), np.array(self.backdrop.color, np.float32)
        rows = {
            "means": positions, "quats": [1, 0, 0, 0], "log_scales": [math.log(scale)] * 3,
            "logit_opacities": np.log(opacity / (1 - opacity)),
            "sh_dc": (color - np.float32(0.5)) / np.float32(SH_C0)}
        together = {name: np.concatenate([value, np.broadcast_to(
            np.asarray(rows[name], np.float32), (len(positions), *value.shape[1:]))])
            for name, value in self.parameters().items() if name in rows}
        return replace(self._changed(together), backdrop=None)

    def _changed(self, values: Mapping[str, Floats]) -> SplatArrays:
        return SplatArrays.from_parameters({**self.parameters(), **values}, self.backdrop)

    @property
    def sh_degree(self) -> int:
        """The scene's degree, 0 to 3: that of the Gaussians that have coefficients."""
        return TERMS.index(self.sh_rest.shape[1])

    @property
    def scales(self) -> Floats:
        """Standard deviations along the own axes, [N, 3], world units."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_scales)

    @property
    def opacities(self) -> Floats:
        """Opacities in (0, 1), [N]."""
        with np.errstate(over="ignore"):
            return np.asarray(1 / (1 + np.exp(-self.logit_opacities)), np.float32)

    @property
    def background(self) -> Floats:
        """The colour behind all Gaussians, [3] in [0, 1]."""
        return np.array((0, 0, 0) if self.backdrop is None else self.backdrop.color, np.float32)

    def as_arrays(self) -> SplatArrays:
        """Returns the same, as `Splats.as_arrays` does of tensors."""
        return self

    def as_tensors(self) -> Splats:
        """Returns the same as tensors of torch, which share the memory."""
        import torch

        from recon_cli.scene.splats import Splats

        return Splats.from_parameters(
            {name: torch.from_numpy(value) for name, value in self.parameters().items()},
            self.backdrop)
