"""One whole optimization step, and the losses in it: the only place that knows their parts.

A faster step or loss is added here; nothing else of the benchmark changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.bench.scenes import BenchScene
from recon_cli.config import RunConfig
from recon_cli.render.numba.loss import C1, C2, MAPS, RADIUS, photometric, taps
from recon_cli.train.losses import photometric_loss
from recon_cli.train.optimizer import SplatOptimizer
from recon_cli.train.step import TrainView, gradient_step

Mark = Callable[[str], None]
ADAM = "adam"  # the part of a step that moves the parameters


def training_step(scene: BenchScene, backend: str) -> Callable[[Mark], None]:
    """Returns a function that takes one step as `recon_cli.train.fit` does and marks its parts.

    The learning rates are zero, so that every step of every candidate meets the same scene; Adam
    does the same arithmetic.
    """
    still = replace(
        RunConfig(), means_rate=0.0, quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0,
        sh_rate=0.0)
    optimizer = SplatOptimizer(scene.splats, still, 1.0, backend=backend)
    compute = gradient_step(backend, scene.splats.means.device)
    view = TrainView(scene.camera, noise(scene))

    def step(mark: Mark) -> None:
        compute(optimizer, view, scene.sh_degree, still.ssim_weight)
        mark("gradients")
        optimizer.step(still.means_rate, sh_rest=scene.sh_degree > 0)
        mark(ADAM)

    return step


def loss_passes(scene: BenchScene, device: str) -> dict[str, Callable[[], object]]:
    """Returns, by name, what computes the photometric loss and its gradient on an image.

    "torch" is what the others are compared with.
    """
    weight, truth = RunConfig().ssim_weight, noise(scene)
    target = torch.from_numpy(truth).to(device).float() / 255
    image = target.flip(0).contiguous()
    leaf = image.clone().requires_grad_()
    passes: dict[str, Callable[[], object]] = {
        "torch": lambda: torch.autograd.grad(photometric_loss(leaf, target, weight), leaf)}
    passes["autograd"] = lambda: torch.autograd.grad(
        convolution_loss(leaf, target, weight), leaf)
    if device == "cpu":
        rgb, gradient = image.numpy().reshape(-1), np.empty(image.numel(), np.float32)
        maps = np.empty(MAPS * image.numel(), np.float32)
        passes["fused"] = lambda: photometric(
            rgb, truth.reshape(-1), scene.camera.width, scene.camera.height, weight, maps=maps,
            gradient=gradient)
    return passes


def convolution_loss(image: Tensor, truth: Tensor, ssim_weight: float) -> Tensor:
    """Returns (1 - w) L1 + w (1 - SSIM) in the way that most trainers write it.

    Five grouped convolutions with the 11x11 window, differentiated by autograd. Its numbers are
    those of `photometric_loss`; only its time is of interest.
    """
    line = image.new_tensor(taps())
    window = (line[:, None] * line).expand(3, 1, -1, -1)

    def blur(planes: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(planes, window, padding=RADIUS, groups=3)

    x, y = (item.permute(2, 0, 1)[None] for item in (image, truth))
    mu_x, mu_y = blur(x), blur(y)
    variances = blur(x * x) - mu_x * mu_x + blur(y * y) - mu_y * mu_y
    covariance = blur(x * y) - mu_x * mu_y
    ssim: Tensor = ((2 * mu_x * mu_y + float(C1)) * (2 * covariance + float(C2))) / (
        (mu_x * mu_x + mu_y * mu_y + float(C1)) * (variances + float(C2)))
    loss: Tensor = (
        (1 - ssim_weight) * (image - truth).abs().mean() + ssim_weight * (1 - ssim.mean()))
    return loss


def noise(scene: BenchScene) -> NDArray[np.uint8]:
    """Returns a random photograph of the scene's size, [H, W, 3]."""
    size = (scene.camera.height, scene.camera.width, 3)
    return np.random.default_rng(0).integers(0, 256, size, np.uint8)
