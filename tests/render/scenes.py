"""Scenes for the rasterizer's tests: small, seeded, with the awkward cases mixed in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0, Splats


def camera_at(width: int = 50, height: int = 37, *, focal: float = 40.0) -> Camera:
    """A camera that looks along +z, turned a little, with an off-centre principal point."""
    angle = 0.1
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    viewmat[:3, 3] = [0.1, -0.05, 0.2]
    return Camera(width, height, focal, 1.1 * focal, width / 2 + 1.3, height / 2 - 0.7, viewmat)


def move_camera(camera: Camera, turn: np.ndarray, move: np.ndarray) -> Camera:
    """The camera, turned about its centre by a rotation vector in world axes, and then moved."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ Rotation.from_rotvec(turn).as_matrix().T
    viewmat[:3, 3] = -viewmat[:3, :3] @ (camera.center + move)
    return replace(camera, viewmat=viewmat)


def random_splats(n: int, *, seed: int = 0, dtype: torch.dtype = torch.float64) -> Splats:
    """N Gaussians in front of `camera_at`: some needles, some opaque, some behind the camera."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.5, -1.2, -0.5], [1.5, 1.2, 5.0], (n, 3))
    log_scales = rng.normal(-2.3, 0.6, (n, 3))
    log_scales[::7, 0] += 2.0
    values = {
        "means": means,
        "quats": rng.normal(size=(n, 4)),
        "log_scales": log_scales,
        "logit_opacities": rng.normal(0.5, 2.0, n),
        "sh_dc": rng.normal(0, 0.8, (n, 3)),
        "sh_rest": rng.normal(0, 0.1, (n, 15, 3)),
    }
    return Splats(**{k: torch.tensor(v, dtype=dtype) for k, v in values.items()})


def with_harmonics(splats: Splats, degree: int, colored: int) -> Splats:
    """The same, of a scene's degree, of which the first `colored` have coefficients."""
    return replace(splats, sh_rest=splats.with_degree(degree).sh_rest[:colored])


def one_splat(
    mean: tuple[float, float, float], *, scale: float, opacity: float,
    color: tuple[float, float, float], dtype: torch.dtype = torch.float64,
) -> Splats:
    """One round Gaussian of a plain colour."""
    return Splats(
        means=torch.tensor([mean], dtype=dtype),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=dtype),
        log_scales=torch.full((1, 3), math.log(scale), dtype=dtype),
        logit_opacities=torch.tensor([math.log(opacity / (1 - opacity))], dtype=dtype),
        sh_dc=(torch.tensor([color], dtype=dtype) - 0.5) / SH_C0,
        sh_rest=torch.zeros(1, 15, 3, dtype=dtype),
    )


def joined(*parts: Splats) -> Splats:
    """The Gaussians of all parts in one."""
    names = parts[0].parameters()
    return Splats(**{name: torch.cat([getattr(p, name) for p in parts]) for name in names})


def leaves(splats: Splats) -> Splats:
    """A copy whose every parameter collects gradients."""
    return splats.map(lambda tensor: tensor.detach().clone().requires_grad_())
