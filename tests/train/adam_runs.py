"""Runs of every kind of Adam on gradients as training has them, and how they are compared."""

import pytest
import torch
from interpreter import INTERPRETED
from scenes import random_splats

from recon_cli.config.stages import RunConfig
from recon_cli.train.fit.optimizer import SplatOptimizer

# float32 in another order of operations, over 20 steps: a few units in the last place.
STEPS_TOLERANCE = 1e-6
ROLES = "exp_avg", "exp_avg_sq"
CONFIG = RunConfig(max_gaussians=50)
# triton in its interpreter; on a GPU tests/train/test_triton_step.py holds it against torch
BACKENDS = ("torch", "numba", "triton")[:3 if INTERPRETED else 2]
KERNELS = BACKENDS[1:]  # which move all parameters at once
every_kind = pytest.mark.parametrize("backend", BACKENDS)


def optimizer_of(n, *, backend, config=CONFIG):
    splats = random_splats(n, dtype=torch.float32)
    return SplatOptimizer(splats, config, means_unit=2.0, backend=backend)


def gradients_of(n, step):
    """Gradients as they are in training: of any size, many of them zero, some denormal."""
    generator = torch.Generator().manual_seed(step)

    def draw(tensor):
        sizes = 10 ** (torch.randn(tensor.shape, generator=generator) * 4 - 6)
        signs = torch.randint(-1, 2, tensor.shape, generator=generator)
        return sizes * signs

    return random_splats(n, dtype=torch.float32).map(draw)


def feed(optimizer, gradients):
    """Leaves gradients where each kind of optimizer looks for them."""
    for name, value in gradients.parameters().items():
        if optimizer.fused:
            getattr(optimizer.gradients, name).copy_(value)
        else:
            getattr(optimizer.splats, name).grad = value.clone()


def walk(optimizer, steps, *, start=0, sh_rest=True):
    for step in range(start, start + steps):
        feed(optimizer, gradients_of(len(optimizer.splats), step))
        optimizer.step(1e-4, sh_rest=sh_rest)


def held(optimizer):
    return {name: value.clone() for name, value in optimizer.tensors().items()}


def assert_close(ours, theirs):
    for name, value in theirs.items():
        assert ours[name].shape == value.shape
        if not value.numel():
            continue
        scale = max(1.0, value.abs().max().item()) if name.startswith("splats") else (
            value.abs().max().item())
        assert (ours[name] - value).abs().max() <= STEPS_TOLERANCE * scale, name
