"""One whole optimization step, and the losses in it: the only place that knows their parts.

A faster step or loss is added here; nothing else of the benchmark changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.bench.scenes import BenchScene
from recon_cli.config import TrainConfig
from recon_cli.render.numba.step import PhotometricStep
from recon_cli.train.losses import photometric_loss
from recon_cli.train.optimizer import SplatOptimizer
from recon_cli.train.step import TrainView, fuses, gradient_step

Mark = Callable[[str], None]
ADAM = "adam"  # the part of a step that moves the parameters


def training_step(scene: BenchScene, backend: str) -> Callable[[Mark], None]:
    """Returns a function that takes one step as `recon_cli.train.fit` does and marks its parts.

    The learning rates are zero, so that every step of every candidate meets the same scene; Adam
    does the same arithmetic.
    """
    still = replace(
        TrainConfig(), means_rate=0.0, quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0,
        sh_rate=0.0)
    optimizer = SplatOptimizer(scene.splats, still, 1.0, fused=fuses(backend))
    compute, view = gradient_step(backend), TrainView(scene.camera, noise(scene))

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
    weight, truth = TrainConfig().ssim_weight, noise(scene)
    target = torch.from_numpy(truth).to(device).float() / 255
    image = target.flip(0).contiguous()
    leaf = image.clone().requires_grad_()
    passes: dict[str, Callable[[], object]] = {
        "torch": lambda: torch.autograd.grad(photometric_loss(leaf, target, weight), leaf)}
    if device == "cpu":
        fused = PhotometricStep()
        rgb, gradient = image.numpy().reshape(-1), np.empty(image.numel(), np.float32)
        passes["fused"] = lambda: fused._loss(
            rgb, truth.reshape(-1), scene.camera.width, scene.camera.height, weight, gradient)
    return passes


def noise(scene: BenchScene) -> NDArray[np.uint8]:
    """Returns a random photograph of the scene's size, [H, W, 3]."""
    size = (scene.camera.height, scene.camera.width, 3)
    return np.random.default_rng(0).integers(0, 256, size, np.uint8)
