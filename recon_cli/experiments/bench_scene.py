"""The benchmark's synthetic room, and errors of renderers against an oracle.

The oracle is the torch backend in float64, which the tests compare with an untiled brute force
within 1e-12. All parameters are rounded to float32 before, so that only arithmetic is measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from recon_cli.render.contract import Renderer
from recon_cli.render.torch import tiles
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

_ROOM = np.array([6.0, 4.0, 3.0])  # metres; z is up
_BOXES = 12  # pieces of furniture
_AREA = 2 * (24 + 18 + 12) + _BOXES * 2.4  # square metres of walls and furniture, about
_COVERAGE = 0.45  # standard deviation over spacing: that of trained scenes within a factor of 2
FLIP = 1e-5  # a larger error of a pixel means a fragment more or less, not rounding
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
class BenchScene:
    """The input of every candidate."""

    splats: Splats  # N Gaussians, float32
    camera: Camera  # inside the room
    background: Tensor  # [3]
    sh_degree: int
    weights: Tensor  # [H, W, 3] seeded normal numbers; the loss is the sum of image times these


def build_scene(size: SceneSize, sh_degree: int, device: str, *, seed: int = 0) -> BenchScene:
    """Returns the room of a size on a device, the same values for the same seed."""
    splats, camera = room(size.gaussians, size.width, size.height, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(size.height, size.width, 3, generator=generator)
    return BenchScene(
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
    forward = np.array([3.5, 2.0, -0.4]) / np.linalg.norm([3.5, 2.0, -0.4])
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [1.0, 1.0, 1.6]
    focal = 0.85 * width
    return splats, Camera(width, height, focal, focal, width / 2, height / 2, viewmat)


@dataclass(frozen=True, eq=False)
class Answer:
    """The output of one renderer, in float64."""

    image: Tensor  # [H, W, 3]
    gradients: dict[str, Tensor]  # by raw parameter, of the sum of image times scene.weights


@dataclass(frozen=True)
class Accuracy:
    """The error of an answer against the oracle's."""

    image_error_max: float  # largest difference of a channel of a pixel
    image_error_rms: float  # root of the mean square of the differences
    flipped_pixels: float  # fraction of the pixels with a channel that errs by more than FLIP
    gradient_relative_error: float  # ||g - g*|| / ||g*||, of the raw parameter where it is largest
    gradient_worst: str  # the name of that parameter
    gradient_cosine: float  # of all gradients in a row, each parameter's divided by its ||g*||


def answer(scene: BenchScene, renderer: Renderer) -> Answer:
    """Returns the image and the gradients of a renderer, in the dtype of the scene."""
    splats = scene.splats.map(lambda tensor: tensor.detach().requires_grad_())
    output = renderer(splats, scene.camera, scene.background, scene.sh_degree, False)
    leaves = splats.parameters()
    computed = torch.autograd.grad(
        output.rgb, list(leaves.values()), scene.weights, allow_unused=True)
    gradients = {
        name: (torch.zeros_like(leaf) if gradient is None else gradient).double()
        for (name, leaf), gradient in zip(leaves.items(), computed, strict=True)}
    return Answer(output.rgb.detach().double(), gradients)


def oracle(scene: BenchScene) -> Answer:
    """Returns the answer in float64 for the same float32 parameters."""
    return answer(replace(
        scene, splats=scene.splats.map(torch.Tensor.double),
        background=scene.background.double(), weights=scene.weights.double()), tiles.render)


def accuracy(candidate: Answer, truth: Answer) -> Accuracy:
    """Returns the error of `candidate`, infinite (cosine 0) where it is not finite."""
    difference = (candidate.image - truth.image).abs()
    relative, cosine = _compare(candidate.gradients, truth.gradients)
    worst = max(relative, key=lambda name: relative[name], default="")
    return Accuracy(
        _inf_if_nan(difference.max()), _inf_if_nan(difference.square().mean().sqrt()),
        float((~(difference.amax(-1) <= FLIP)).double().mean()),
        relative.get(worst, 0.0), worst, cosine)


def _compare(
    candidate: Mapping[str, Tensor], true: Mapping[str, Tensor]
) -> tuple[dict[str, float], float]:
    """Returns the relative error of each parameter's gradient, and the cosine over all of them."""
    relative: dict[str, float] = {}
    product = square = count = 0.0
    for name, gradient in true.items():
        length = float(gradient.norm())
        if length == 0:
            continue
        scaled, unit = candidate[name] / length, gradient / length
        relative[name] = _inf_if_nan((scaled - unit).norm())
        product += float((scaled * unit).sum())
        square += float(scaled.square().sum())
        count += 1
    if not math.isfinite(square):
        return relative, 0.0
    return relative, product / (square * count) ** 0.5 if square else 0.0


def _inf_if_nan(error: Tensor) -> float:
    """Returns an error as a number, infinite where it is NaN."""
    value = float(error)
    return math.inf if math.isnan(value) else value
