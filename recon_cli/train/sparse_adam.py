"""Adam over a table with one row for each training image, of which a step moves a single one."""

from __future__ import annotations

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

_BETAS = 0.9, 0.999  # of the paper, and of INRIA 3DGS for its exposures
_EPSILON = 1e-15  # as for the splats: the gradient of a mean over all pixels is small
_ROLES = ("value", "exp_avg", "exp_avg_sq", "count")


class SparseAdam:
    """Adam (Kingma and Ba 2015, algorithm 1) that counts the steps of each row on its own.

    A row that was stepped for the first time moves by its rate, however late that is. On the CPU
    and in float64: the table is small, and the same whatever the device.

    Args:
        start: [F, D] values before the first step; copied.

    Attributes:
        value: [F, D] float64.
    """

    def __init__(self, start: Tensor) -> None:
        self.value = start.double().clone()
        self._exp_avg = torch.zeros_like(self.value)
        self._exp_avg_sq = torch.zeros_like(self.value)
        self._count = torch.zeros(len(start), dtype=torch.float64)

    @property
    def complete(self) -> bool:
        """Whether every row was stepped at least once."""
        return bool((self._count > 0).all())

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
        seen = self._count > 0
        if seen.any():
            self.value[seen] -= self.value.sum(dim=0) / seen.sum()

    def tensors(self, prefix: str) -> dict[str, Tensor]:
        """Returns values, moments and counts by name, for a checkpoint."""
        return {f"{prefix}.{role}": self._held(role) for role in _ROLES}

    def restore(self, prefix: str, tensors: dict[str, Tensor]) -> None:
        """Takes back what `tensors` returned.

        Raises:
            KeyError: one is missing.
            RuntimeError: they are of another number of images.
        """
        for role in _ROLES:
            self._held(role).copy_(tensors[f"{prefix}.{role}"])

    def _held(self, role: str) -> Tensor:
        held: Tensor = getattr(self, role if role == "value" else f"_{role}")
        return held
