"""One view's loss and gradients, by whichever backend runs.

SSIM is that of the reference's loss: 11 taps, sigma 1.5, zeros beyond the border, mean over all
pixels and channels (Wang et al. 2004, eq. 13). Autograd through five blurs would keep some thirty
images alive; the closed form keeps nine.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from recon_cli.render import Statistics, render
from recon_cli.render.contract import StepOptions, TargetDepth, TargetImage
from recon_cli.render.depth_loss import depth_loss
from recon_cli.render.response import Response, ResponseGradient, ResponseTensors
from recon_cli.scene.train_view import BORDER, SSIM_C1, SSIM_C2, SSIM_SIGMA, TrainView
from recon_cli.train.fit.optimizer import SplatOptimizer

if TYPE_CHECKING:
    from recon_cli.render.triton.step_status import StepReport, StepStatus

# Relative, of a rendered depth: it is a mean of those of the centres of Gaussians, which lie before
# and behind the surface. Without it, sensors of 1% cost .3 to .9 dB (two rooms).
RENDERED_NOISE = 0.05


class GradientStep(Protocol):
    """Leaves the gradients of (1 - w) L1 + w (1 - SSIM) of a masked view in an optimizer.

    With `options.depth_weight` that of the depth is added, if a sensor measured it in the view.
    """

    @property
    def response_gradient(self) -> ResponseGradient:
        """Gradients of the response of the last view that was given one."""

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions,
        response: Response | None = None,
    ) -> tuple[float, Statistics | None]:
        """Returns loss and statistics of a view, None where it sees no Gaussian.

        Statistics are valid until the next call. The photograph is the render's after `response`.
        """


class DeferredStep(GradientStep, Protocol):
    """A gradient step that can also be started without waiting for its result."""

    @property
    def counted(self) -> Tensor:
        """[1] int32 on the device: zero where the last view came to nothing."""

    @property
    def status(self) -> StepStatus:
        """The device's record of each view."""

    def start(self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions) -> Statistics:
        """Starts the work on one view and returns its statistics, zeros where it counts nothing."""

    def close(self) -> StepReport:
        """Waits for the work, and tells the outcome of the views since it was last called."""


def gradient_step(backend: str, device: torch.device | str = "cpu") -> GradientStep:
    """Returns the way from a view to its gradients that is fastest with a backend."""
    if backend == "numba":
        return _FusedStep()
    if backend == "triton":
        return _DeviceStep(torch.device(device))
    return _AutogradStep(backend)


class _FusedStep:
    """The numba backend's own loss and gradients, in buffers that are used again."""

    def __init__(self) -> None:
        from recon_cli.render.numba.step import PhotometricStep

        self._compute = PhotometricStep()

    @property
    def response_gradient(self) -> ResponseGradient:
        return self._compute.response_gradient

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions,
        response: Response | None = None,
    ) -> tuple[float, Statistics | None]:
        loss = self._compute(
            optimizer.splats, optimizer.gradients, view.camera,
            _target(view, response, options), options)
        return loss, self._compute.statistics if self._compute.instances else None


class _DeviceStep:
    """The triton backend's own loss and gradients; nothing but `close` waits for the device."""

    def __init__(self, device: torch.device) -> None:
        from recon_cli.render.triton.step import PhotometricStep

        self._compute = PhotometricStep(device)
        self.response_gradient = ResponseGradient.zeros()

    @property
    def counted(self) -> Tensor:
        return self._compute.counted

    @property
    def status(self) -> StepStatus:
        return self._compute.status

    def start(
        self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions,
        response: Response | None = None,
    ) -> Statistics:
        self._compute(
            optimizer.splats.map(lambda tensor: tensor.detach()), optimizer.gradients, view.camera,
            _target(view, response, options), options)
        return self._compute.statistics

    def close(self) -> StepReport:
        return self._compute.close()

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions,
        response: Response | None = None,
    ) -> tuple[float, Statistics | None]:
        while True:
            statistics = self.start(optimizer, view, options, response)
            report = self.close()
            if report.stopped is None:  # else there is room for it now
                break
        if response is not None and self._compute.response_tensors is not None:
            self.response_gradient = self._compute.response_tensors.gradient()
        return report.loss, statistics if report.instances else None


class _AutogradStep:
    """Any backend that is differentiable by autograd."""

    def __init__(self, backend: str) -> None:
        self._backend = backend
        self.response_gradient = ResponseGradient.zeros()

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions,
        response: Response | None = None,
    ) -> tuple[float, Statistics | None]:
        splats = optimizer.splats
        device, counting = splats.means.device, view.counting(splats.means.device)
        output = render(
            splats, view.camera, splats.background, options.sh_degree,
            backend=self._backend, scores=options.details or options.scores or options.loo,
            mask=counting)
        rgb = output.rgb
        tensors = None if response is None else ResponseTensors(response, view.camera, rgb)
        if tensors is not None:
            rgb = tensors.apply(rgb)
        loss = photometric_loss(rgb, view.pixels(device), options.ssim_weight, mask=counting)
        target = _target_depth(view, options)
        if target is not None:
            truth = torch.from_numpy(target.depths).to(output.depth)
            loss = loss + depth_loss(
                output.depth, output.alpha, truth, target.noise, target.factor)
        value = float(loss.detach())
        if not (loss.requires_grad and output.statistics.radii.any()):
            return value, None
        if np.isfinite(value):
            loss.backward()  # type: ignore[no-untyped-call]
            if tensors is not None:
                self.response_gradient = tensors.gradient()
        return value, output.statistics


def _target(
    view: TrainView, response: Response | None, options: StepOptions
) -> TargetImage:
    return TargetImage(view.image, view.mask, response, _target_depth(view, options))


def _target_depth(view: TrainView, options: StepOptions) -> TargetDepth | None:
    """Returns the depth that a view is compared with; None where it is not, or has none."""
    if view.depth is None or options.depth_weight == 0:
        return None
    return TargetDepth(
        view.depth.image(view.camera, view.mask), math.hypot(view.depth.noise, RENDERED_NOISE),
        options.depth_weight / view.depth.cells)


def photometric_loss(
    image: Tensor, truth: Tensor, ssim_weight: float, *, mask: Tensor | None = None
) -> Tensor:
    """Returns (1 - w) L1 + w (1 - SSIM) of images [H, W, 3] (Kerbl et al. 2023, eq. 7).

    Gradients flow to `image`; `truth` is in [0, 1], of the same dtype and device. Pixels where
    `mask` [H, W] is False have no error and no gradient, but the truth there still lies in the
    windows of its neighbours: paint it with something neutral.
    """
    if mask is not None:
        image = torch.where(mask[..., None], image, truth)
    loss = (image - truth).abs().mean()
    if ssim_weight == 0:
        return loss
    ssim: Tensor = _Ssim.apply(image, truth)  # type: ignore[no-untyped-call]
    return (1 - ssim_weight) * loss + ssim_weight * (1 - ssim)


def _taps() -> list[float]:
    """Returns the right half of the normalised window, the centre first."""
    window = torch.exp(-0.5 * (torch.arange(-BORDER, BORDER + 1.0).double() / SSIM_SIGMA) ** 2)
    half: list[float] = (window / window.sum())[BORDER:].tolist()
    return half


def blur(images: Tensor) -> Tensor:
    """Returns [..., H, W] images convolved with the window; zeros lie beyond the border."""
    taps = _taps()  # shifted additions: ten times faster on a CPU than a grouped convolution
    for axis in (-1, -2):
        length = images.shape[axis]
        out = images * taps[0]
        for shift in range(1, min(BORDER, length - 1) + 1):
            rest = length - shift
            out.narrow(axis, 0, rest).add_(images.narrow(axis, shift, rest), alpha=taps[shift])
            out.narrow(axis, shift, rest).add_(images.narrow(axis, 0, rest), alpha=taps[shift])
        images = out
    return images


class _Ssim(torch.autograd.Function):
    """Mean structural similarity of two [H, W, 3] images."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor) -> Tensor:
        x, y = (item.permute(2, 0, 1).contiguous() for item in (image, truth))
        mu_x, mu_y, xx, yy, xy = blur(torch.stack([x, y, x * x, y * y, x * y]))
        a1, a2 = 2 * mu_x * mu_y + SSIM_C1, 2 * (xy - mu_x * mu_y) + SSIM_C2
        b1 = mu_x * mu_x + mu_y * mu_y + SSIM_C1
        b2 = (xx - mu_x * mu_x) + (yy - mu_y * mu_y) + SSIM_C2
        ssim = a1 * a2 / (b1 * b2)
        ctx.save_for_backward(x, y, mu_x, mu_y, a1, a2, b1, b2, ssim)
        mean: Tensor = ssim.mean()
        return mean

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        x, y, mu_x, mu_y, a1, a2, b1, b2, ssim = ctx.saved_tensors
        by_variance = -ssim / b2
        by_covariance = 2 * a1 / (b1 * b2)
        by_mean = (
            2 * mu_y * a2 / (b1 * b2) - 2 * mu_x * ssim / b1
            - 2 * mu_x * by_variance - mu_y * by_covariance)
        # the window is symmetric and the border zero: the blur is its own transpose
        mean, variance, covariance = blur(torch.stack([by_mean, by_variance, by_covariance]))
        slope = mean + 2 * x * variance + y * covariance
        return (slope * (grad / slope.numel())).permute(1, 2, 0), None
