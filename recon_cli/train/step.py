"""One view's loss and gradients, by whichever backend runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render import Statistics, render
from recon_cli.scene.camera import Camera
from recon_cli.train.losses import photometric_loss
from recon_cli.train.optimizer import SplatOptimizer


@dataclass(frozen=True, eq=False)
class TrainView:
    """One view in the form that training reads.

    Attributes:
        camera: at the size of the image.
        image: [H, W, 3] uint8; a fourth of the memory of float32. Under the mask it holds one
            colour that stands for nothing (`io.images.painted`).
        mask: [H, W], True where a pixel counts; None where all do.
    """

    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if self.mask is not None and self.mask.shape != self.image.shape[:2]:
            raise ValueError(f"a mask of {self.mask.shape} for an image of {self.image.shape}")

    def pixels(self, device: torch.device) -> Tensor:
        """Returns the image as float32 in [0, 1], [H, W, 3]."""
        return torch.from_numpy(self.image).to(device).float() / 255

    def counting(self, device: torch.device) -> Tensor | None:
        """Returns the mask, [H, W] bool."""
        return None if self.mask is None else torch.from_numpy(self.mask).to(device)


class GradientStep(Protocol):
    """Leaves the gradients of (1 - w) L1 + w (1 - SSIM) of one view in an optimizer.

    Pixels that the view's mask ignores have no error and no gradient.
    """

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, sh_degree: int, ssim_weight: float,
        *, variance: bool = False, scores: bool = False, loo: bool = False,
    ) -> tuple[float, Statistics | None]:
        """Returns the loss and the statistics of the view; None where it sees no Gaussian.

        The statistics are valid until the next call. Their `variance` is computed where it is
        asked for, and so are the scores (hits and blend weights) and loo, over the pixels that
        the view's mask counts.
        """


def gradient_step(backend: str) -> GradientStep:
    """Returns the way from a view to its gradients that is fastest with a backend."""
    return _FusedStep() if fuses(backend) else _AutogradStep(backend)


def fuses(backend: str) -> bool:
    """Tells whether a backend computes loss and gradients without autograd."""
    return backend == "numba"


class _FusedStep:
    """The numba backend's own loss and gradients, in buffers that are used again."""

    def __init__(self) -> None:
        from recon_cli.render.numba.step import PhotometricStep

        self._compute = PhotometricStep()
        self._background = torch.zeros(3)

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, sh_degree: int, ssim_weight: float,
        *, variance: bool = False, scores: bool = False, loo: bool = False,
    ) -> tuple[float, Statistics | None]:
        """Returns the loss and the statistics of the view."""
        loss = self._compute(
            optimizer.splats, optimizer.gradients, view.camera, view.image, self._background,
            sh_degree, ssim_weight, mask=view.mask, details=variance,
            scores=scores, loo=loo)
        return loss, self._compute.statistics if self._compute.instances else None


class _AutogradStep:
    """Any backend that is differentiable by autograd."""

    def __init__(self, backend: str) -> None:
        self._backend = backend

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, sh_degree: int, ssim_weight: float,
        *, variance: bool = False, scores: bool = False, loo: bool = False,
    ) -> tuple[float, Statistics | None]:
        """Returns the loss and the statistics of the view."""
        splats = optimizer.splats
        device, counting = splats.means.device, view.counting(splats.means.device)
        output = render(
            splats, view.camera, splats.means.new_zeros(3), sh_degree, backend=self._backend,
            scores=variance or scores or loo, mask=counting)
        loss = photometric_loss(output.rgb, view.pixels(device), ssim_weight, mask=counting)
        value = float(loss.detach())
        if not (loss.requires_grad and output.statistics.radii.any()):
            return value, None
        if np.isfinite(value):
            loss.backward()  # type: ignore[no-untyped-call]
        return value, output.statistics
