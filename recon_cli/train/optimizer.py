"""Adam over the raw parameters, whose rows follow added and removed Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from recon_cli.config import TrainConfig
from recon_cli.scene.splats import Splats

_EPSILON = 1e-15  # of the reference: gradients of single Gaussians are tiny
_REST_FACTOR = 1 / 20  # learning rate of higher SH degrees against the base colour
_MOMENTS = ("exp_avg", "exp_avg_sq")


class SplatOptimizer:
    """torch's fused Adam with one group a parameter.

    Args:
        splats: their tensors become the optimized leaves.
        config: learning rates.
        extent: of the scene in world units; scales the rate of the means.
    """

    def __init__(self, splats: Splats, config: TrainConfig, extent: float) -> None:
        self._extent = extent
        rates = {
            "means": config.means_rate * extent, "quats": config.quats_rate,
            "log_scales": config.scales_rate, "logit_opacities": config.opacities_rate,
            "sh_dc": config.sh_rate, "sh_rest": config.sh_rate * _REST_FACTOR,
        }
        self.splats = splats.map(lambda tensor: tensor.detach().requires_grad_())
        self._adam = torch.optim.Adam(
            [{"params": [value], "lr": rates[name], "name": name}
             for name, value in self.splats.parameters().items()],
            eps=_EPSILON, fused=True)

    def step(self, means_rate: float) -> None:
        """Moves the parameters against their gradients, which are then dropped.

        Args:
            means_rate: learning rate of the means in units of the scene extent.
        """
        self._adam.param_groups[0]["lr"] = means_rate * self._extent
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def replace(self, splats: Splats, source: Tensor) -> None:
        """Goes on with other Gaussians.

        Args:
            splats: the new Gaussians, M of them.
            source: [M] the old row that each continues, whose moments it keeps; -1 for a new one,
                which starts with zeros.
        """
        fresh = source < 0
        rows = source.clamp_min(0)
        for group, value in zip(
            self._adam.param_groups, splats.parameters().values(), strict=True
        ):
            state = self._adam.state.pop(group["params"][0], {})
            leaf = value.detach().contiguous().requires_grad_()
            for key in _MOMENTS:
                if key in state:
                    state[key] = state[key][rows]
                    state[key][fresh] = 0
            group["params"] = [leaf]
            if state:
                self._adam.state[leaf] = state
        leaves = [group["params"][0] for group in self._adam.param_groups]
        self.splats = Splats(*leaves)

    def forget(self, name: str) -> None:
        """Zeroes the moments of one parameter."""
        for key in _MOMENTS:
            state = self._adam.state[getattr(self.splats, name)]
            if key in state:
                state[key].zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Returns parameters, moments and step counts by name, for a checkpoint."""
        result: dict[str, Tensor] = {}
        for name, value in self.splats.parameters().items():
            result[f"splats.{name}"] = value.detach()
            for key, item in self._adam.state[value].items():
                result[f"adam.{name}.{key}"] = item
        return result

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Takes moments and step counts back from what `tensors` returned."""
        for name, value in self.splats.parameters().items():
            prefix = f"adam.{name}."
            state = {key.removeprefix(prefix): item.clone()
                     for key, item in tensors.items() if key.startswith(prefix)}
            if state:
                self._adam.state[value] = state
