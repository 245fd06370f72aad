"""Adam over the raw parameters, whose rows follow added and removed Gaussians; Adam by image."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from recon_cli.config.stages import RunConfig
from recon_cli.scene.splats import Splats, with_terms
from recon_cli.train.fit.schedule import RECIPES

_BETAS = 0.9, 0.999  # of the paper, and of INRIA 3DGS for its exposures
_EPSILON = 1e-15  # of the reference: gradients of single Gaussians are tiny
_REST_FACTOR = 1 / 20  # learning rate of higher SH degrees against the base colour
_ROLES = ("value", "gradient", "exp_avg", "exp_avg_sq")
_MOMENTS = ("exp_avg", "exp_avg_sq")
_ROW_ROLES = ("value", "exp_avg", "exp_avg_sq", "count")


class SplatOptimizer:
    """Adam with a learning rate for each parameter (Kingma and Ba 2015, algorithm 1).

    Values (copied from `splats`), gradients and moments lie in buffers with room for more
    Gaussians; memory that was never used costs nothing. `self.splats`, leaves of autograd, and
    `self.gradients` are views of them. numba and triton write into `gradients` and move all
    parameters by one kernel; with torch, autograd leaves the gradients in `splats`. `means_unit`
    is that of the means' rate, in world units (`Task.means_unit`).
    """

    def __init__(
        self, splats: Splats, config: RunConfig, means_unit: float, *, backend: str = "torch"
    ) -> None:
        self._means_unit, self._backend = means_unit, backend
        recipe = RECIPES[config.densify]
        self._betas = recipe.momentum, _BETAS[1]
        self._rates = {
            "means": config.means_rate * means_unit, "quats": config.quats_rate,
            "log_scales": recipe.scales_rate * config.scales_rate,
            "logit_opacities": config.opacities_rate, "sh_dc": recipe.sh_rate * config.sh_rate,
            "sh_rest": recipe.sh_rest_rate * config.sh_rate * _REST_FACTOR}
        # on the device where a step may come to nothing there without the host's knowledge
        self._taken = torch.zeros(1, dtype=torch.int64)
        if backend == "triton":
            self._taken = self._taken.to(splats.means.device)
        self._factor = 1.0
        self._buffers: dict[str, dict[str, Tensor]] = {}
        self._accumulated: dict[str, Tensor] = {}
        self._capacity = max(len(splats), config.max_gaussians)
        self._show(splats)
        with torch.no_grad():
            for name, value in splats.parameters().items():
                getattr(self.splats, name).copy_(value)
                for role in _MOMENTS:
                    self._view(name, role).zero_()

    @property
    def fused(self) -> bool:
        """Whether the backend writes the gradients and moves the parameters by its own kernels."""
        return self._backend in ("numba", "triton")

    @property
    def count(self) -> int:
        """Steps taken; with triton this waits for the device."""
        return int(self._taken)

    def _reserve(self, name: str, like: Tensor, rows: int) -> None:
        roles = _ROLES if self.fused else [role for role in _ROLES if role != "gradient"]
        self._buffers[name] = {
            role: torch.empty(rows, *like.shape[1:], dtype=like.dtype, device=like.device)
            for role in roles}

    def _view(self, name: str, role: str) -> Tensor:
        return self._buffers[name][role][: self._rows[name]]

    def _show(self, like: Splats) -> None:
        """Makes as many rows of the buffers as `like` has the Gaussians of the moment."""
        self._capacity = max(self._capacity, len(like))
        self._rows = {name: len(value) for name, value in like.parameters().items()}
        for name, value in like.parameters().items():
            # no empty room for SH coefficients that only some have: they are few to spare a GPU
            room = self._capacity if len(value) == len(like) else len(value)
            held = self._buffers.get(name, {}).get("value")
            if held is None or held.shape != (room, *value.shape[1:]):
                self._reserve(name, value, room)
        self.splats = Splats.from_parameters({
            name: self._view(name, "value").detach().requires_grad_() for name in self._buffers
        }, like.backdrop)
        self.gradients = Splats.from_parameters({
            name: self._view(name, "gradient") for name in self._buffers
        }) if self.fused else self.splats

    def gradient(self, name: str) -> Tensor:
        """Returns the gradient of a parameter that the last backward pass left, to be changed."""
        if self.fused:
            return self._view(name, "gradient")
        gradient: Tensor | None = getattr(self.splats, name).grad
        if gradient is None:
            raise ValueError(f"{name} has no gradient")
        return gradient

    @torch.no_grad()
    def accumulate(self, share: float, *, sh_rest: bool) -> None:
        """Adds a share of the gradients, those of one view of several, and uses them up."""
        for name in self._names(sh_rest=sh_rest):
            value = getattr(self.splats, name)
            if not self.fused and value.grad is None:
                continue
            if name not in self._accumulated:
                self._accumulated[name] = torch.zeros_like(value)
            self._accumulated[name].add_(self.gradient(name), alpha=share)
        self.discard()

    def discard(self) -> None:
        """Uses the gradients up without a step."""
        for value in self.splats.parameters().values():
            value.grad = None  # autograd would add the next one to it

    @torch.no_grad()
    def take_accumulated(self, *, sh_rest: bool) -> list[Tensor]:
        """Makes the accumulated gradients those of the next step; returns them to be changed."""
        gradients = []
        for name in self._names(sh_rest=sh_rest):
            value = getattr(self.splats, name)
            total = self._accumulated.pop(name, None)
            total = torch.zeros_like(value) if total is None else total
            if self.fused:
                total = self._view(name, "gradient").copy_(total)
            else:
                value.grad = total
            gradients.append(total)
        return gradients

    def _names(self, *, sh_rest: bool) -> list[str]:
        return [name for name in self._buffers if sh_rest or name != "sh_rest"]

    def step(
        self, means_rate: float, *, sh_rest: bool = True, factor: float = 1.0,
        counted: Tensor | None = None,
    ) -> None:
        """Moves the parameters against their gradients, which are then used up.

        `means_rate` is in units of `means_unit`; `factor` scales all other rates. Without `sh_rest`
        the higher SH degrees stay. `counted` [1] int32 is zero on the device where nothing is to be
        moved (triton only).
        """
        self._factor = factor
        self._rates["means"] = means_rate * self._means_unit / factor
        names = self._names(sh_rest=sh_rest)
        if self._backend == "triton":
            from recon_cli.render.triton import optimizer as triton_optimizer

            triton_optimizer.step(
                *self._groups(names), taken=self._taken, counted=counted, betas=self._betas,
                epsilon=_EPSILON)
            return
        self._taken += 1
        if self.fused:
            from recon_cli.render.numba import optimizer as numba_optimizer

            numba_optimizer.step(
                *self._groups(names), count=self.count, betas=self._betas, epsilon=_EPSILON)
        else:
            self._step_torch(names)

    def _groups(self, names: list[str]) -> tuple[Any, ...]:
        """Returns values, gradients, pair of moments and rates, as lists over all parameters."""
        values, gradients, first, second = (
            [self._view(name, role).reshape(-1) for name in self._buffers] for role in _ROLES)
        rates = [self._factor * self._rates[name] if name in names else None
                 for name in self._buffers]
        return values, gradients, (first, second), rates

    @torch.no_grad()
    def _step_torch(self, names: list[str]) -> None:
        for name in self._buffers:
            value = getattr(self.splats, name)
            if value.grad is None or name not in names:
                value.grad = None
                continue
            count = torch.full((), self.count - 1.0, device=value.device)
            adam([value], [value.grad], [self._view(name, "exp_avg")],
                 [self._view(name, "exp_avg_sq")], [], [count], fused=True, amsgrad=False,
                 beta1=self._betas[0], beta2=self._betas[1], lr=self._factor * self._rates[name],
                 weight_decay=0.0, eps=_EPSILON, maximize=False)
            value.grad = None

    @torch.no_grad()
    def replace(self, splats: Splats, source: Tensor) -> None:
        """Replaces the Gaussians by N others of any degree.

        `source` [N] is the old row that each continues, whose moments it keeps; -1 for a new one,
        which starts with zeros, as do coefficients that the old row did not have. `splats` may be
        views of this optimizer's own only where every row stays in its place.
        """
        moments = {(name, role): self._view(name, role)
                   for name in self._buffers for role in _MOMENTS}
        self._show(splats)
        for name, value in splats.parameters().items():
            for role in _MOMENTS:  # one parameter at a time: the copies stay small
                self._view(name, role).copy_(
                    _follow_rows(moments.pop((name, role)), source[: len(value)], value))
            self._view(name, "value").copy_(value)

    def forget(self, name: str) -> None:
        """Zeroes the moments of one parameter."""
        for role in _MOMENTS:
            self._view(name, role).zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Returns parameters, moments and the step count by name, for a checkpoint."""
        result = {"adam.count": torch.tensor(self.count)}
        for name in self._buffers:
            result[f"splats.{name}"] = self._view(name, "value")
            for role in _MOMENTS:
                result[f"adam.{name}.{role}"] = self._view(name, role)
        return result

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restores moments and the step count from `tensors`."""
        self._taken.fill_(int(tensors["adam.count"]))
        for name in self._buffers:
            for role in _MOMENTS:
                self._view(name, role).copy_(tensors[f"adam.{name}.{role}"])


def _follow_rows(moment: Tensor, source: Tensor, like: Tensor) -> Tensor:
    """Returns moments of the old rows `source` [K], shaped like `like` [K, ...]; -1 gives 0."""
    if moment.shape[1:] != like.shape[1:]:
        moment = with_terms(moment, like.shape[1])
    if len(moment) == 0:
        return torch.zeros_like(like)
    known = ((source >= 0) & (source < len(moment))).reshape(-1, *[1] * (like.dim() - 1))
    # no mask as an index: a GPU would be waited for
    return torch.where(known, moment[source.clamp(0, len(moment) - 1)], 0.0)


class SparseAdam:
    """Adam (Kingma and Ba 2015, algorithm 1) that counts the steps of each row on its own.

    A row that was stepped for the first time moves by its rate, however late that is. The table
    `value` is [F, D] float64 on the CPU, so that it is the same on every device.
    """

    def __init__(self, start: Tensor) -> None:
        self.value = start.double().clone()
        self._exp_avg = torch.zeros_like(self.value)
        self._exp_avg_sq = torch.zeros_like(self.value)
        self._count = torch.zeros(len(start), dtype=torch.float64)

    def step(self, row: int, gradient: NDArray, rate: float) -> None:  # type: ignore[type-arg]
        """Moves one row against its gradient [D]; a gradient that is not finite moves nothing."""
        grad = torch.as_tensor(gradient, dtype=torch.float64)
        if not torch.isfinite(grad).all():
            return
        adam([self.value[row]], [grad], [self._exp_avg[row]], [self._exp_avg_sq[row]], [],
             [self._count[row]], foreach=False, fused=False, amsgrad=False, beta1=_BETAS[0],
             beta2=_BETAS[1], lr=rate, weight_decay=0.0, eps=_EPSILON, maximize=False)

    def center(self) -> None:
        """Takes the mean of all rows back to 0 by moving those that were ever stepped alike."""
        stepped = self._count > 0
        if stepped.any():
            self.value[stepped] -= self.value.sum(dim=0) / stepped.sum()

    def tensors(self, prefix: str) -> dict[str, Tensor]:
        """Returns values, moments and counts by name, for a checkpoint."""
        return {f"{prefix}.{role}": self._tensor(role) for role in _ROW_ROLES}

    def restore(self, prefix: str, tensors: dict[str, Tensor]) -> None:
        """Restores the state that `tensors` returned.

        Raises:
            KeyError: one is missing.
            RuntimeError: they are of another number of images.
        """
        for role in _ROW_ROLES:
            self._tensor(role).copy_(tensors[f"{prefix}.{role}"])

    def _tensor(self, role: str) -> Tensor:
        tensor: Tensor = getattr(self, role if role == "value" else f"_{role}")
        return tensor
