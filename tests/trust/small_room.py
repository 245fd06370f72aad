"""A small room of Gaussians whose photos are its own renders, and cameras in it."""

from __future__ import annotations

import numpy as np
import torch

from recon_cli.render import render
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView

UP = np.array([0.0, 0.0, 1.0])
EYE = 1.5


def dots(means, *, radius=0.05, opacity=6.0, seed=0) -> Splats:
    """Returns round, nearly opaque Gaussians in random colours."""
    means = torch.as_tensor(np.asarray(means), dtype=torch.float32)
    n = len(means)
    colors = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    return Splats(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
                  torch.full((n, 3), float(np.log(radius))), torch.full((n,), opacity), colors,
                  torch.zeros(0, 0, 3))


def camera(eye, target, *, width=32, height=24, focal=24.0) -> Camera:
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    return Camera(width, height, focal, focal, width / 2, height / 2, looking_at(eye, target, UP))


def photo(splats: Splats, taken: Camera, *, brighter: float = 0.0) -> TrainView:
    with torch.no_grad():
        rgb = render(splats, taken, torch.zeros(3), 0, backend="torch").rgb
    pixels = ((rgb + brighter).clamp(0, 1) * 255).round().numpy().astype(np.uint8)
    return TrainView(taken, pixels)


def room(*, step=0.3, side=4.0, height=2.4) -> np.ndarray:
    """Returns points [N, 3] on the floor and the walls of a square room around the origin."""
    across = np.arange(-side / 2, side / 2 + 1e-9, step)
    up = np.arange(0, height + 1e-9, step)
    floor = np.stack(np.meshgrid(across, across, [0.0]), -1).reshape(-1, 3)
    walls = [np.stack(np.meshgrid([end], across, up), -1).reshape(-1, 3)
             for end in (-side / 2, side / 2)]
    return np.concatenate([floor, *walls, *(wall[:, [1, 0, 2]] for wall in walls)])
