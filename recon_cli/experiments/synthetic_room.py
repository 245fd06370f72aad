"""The synthetic room that rasterizers are measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.splats import Splats

_ROOM = np.array([6.0, 4.0, 3.0])  # metres; z is up
_BOXES = 12  # pieces of furniture
_AREA = 2 * (24 + 18 + 12) + _BOXES * 2.4  # square metres of walls and furniture, about
_COVERAGE = 0.45  # standard deviation over spacing: that of trained scenes within a factor of 2
_THINNESS = 0.15  # of the axis across the wall: trained Gaussians lie flat on surfaces


@dataclass(frozen=True)
class SceneSize:
    """The size of a scene."""

    gaussians: int
    width: int  # of the image in pixels
    height: int


SIZES = {"room": SceneSize(100_000, 640, 360), "small": SceneSize(10_000, 320, 180)}
QUICK = SceneSize(1_500, 160, 90)


@dataclass(frozen=True, eq=False)
class RoomScene:
    """The input of every candidate."""

    splats: Splats  # N Gaussians, float32
    camera: Camera  # inside the room
    background: Tensor  # [3]
    sh_degree: int
    weights: Tensor  # [H, W, 3] seeded normal numbers; the loss is the sum of image times these


def build_scene(size: SceneSize, sh_degree: int, device: str, *, seed: int = 0) -> RoomScene:
    """Returns the room of a size on a device, the same values for the same seed."""
    splats, camera = room(size.gaussians, size.width, size.height, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(size.height, size.width, 3, generator=generator)
    return RoomScene(
        splats.map(lambda tensor: tensor.to(device)), camera, torch.zeros(3, device=device),
        sh_degree, weights.to(device))


def room(n: int, width: int, height: int, *, seed: int = 0) -> tuple[Splats, Camera]:
    """Returns N Gaussians on the walls of a room and on boxes in it, and a camera inside.

    As in a trained scene: flat, of all opacities, view-dependent, in many layers, with needles.
    """
    rng = np.random.default_rng(seed)
    wall = rng.integers(0, 6, n)
    means = rng.random((n, 3)) * _ROOM
    means[np.arange(n), wall // 2] = np.where(wall % 2, _ROOM[wall // 2], 0)
    corners = rng.random((_BOXES, 3)) * (_ROOM - 1)
    edges = 0.3 + 0.7 * rng.random((_BOXES, 3))
    third = n // 3
    box, inside = rng.integers(0, _BOXES, third), rng.random((third, 3))
    inside[np.arange(third), wall[:third] // 2] = wall[:third] % 2
    means[:third] = corners[box] + inside * edges[box]
    scales = _COVERAGE * np.sqrt(_AREA / n) * np.exp(rng.normal(0, 0.5, (n, 3)))
    scales[np.arange(n), wall // 2] *= _THINNESS
    values = {
        "means": means, "quats": rng.normal([1, 0, 0, 0], [1e-9, 0.1, 0.1, 0.1], (n, 4)),
        "log_scales": np.log(scales), "logit_opacities": rng.normal(0.5, 2.0, n),
        "sh_dc": np.sin(means * [3, 5, 7]), "sh_rest": rng.normal(0, 0.05, (n, 15, 3))}
    splats = Splats.from_parameters(
        {k: torch.tensor(v, dtype=torch.float32) for k, v in values.items()})
    # at eye height, looking into the far corner, slightly down
    eye = np.array([1.0, 1.0, 1.6])
    viewmat = looking_at(eye, eye + np.array([3.5, 2.0, -0.4]), np.array([0, 0, 1.0]))
    focal = 0.85 * width
    return splats, Camera(width, height, focal, focal, width / 2, height / 2, viewmat)
