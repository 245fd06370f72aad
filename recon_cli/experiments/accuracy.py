"""How far an image and its gradients are from the oracle: the torch backend in float64.

The tests tie that to an untiled brute force within 1e-12. All parameters are rounded to float32
before the oracle sees them, so that what is measured is arithmetic and not input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon_cli.experiments.bench_scene import BenchScene
from recon_cli.render.contract import Renderer
from recon_cli.render.torch import tiles

FLIP = 1e-5  # a pixel that errs by more has won or lost a fragment: rounding alone stays below


@dataclass(frozen=True, eq=False)
class Answer:
    """What one renderer makes of a scene, in float64."""

    image: Tensor  # [H, W, 3]
    gradients: dict[str, Tensor]  # by raw parameter, of the sum of image times scene.weights


@dataclass(frozen=True)
class Accuracy:
    """The distance of an answer from the oracle's."""

    image_error_max: float  # largest difference of a channel of a pixel
    image_error_rms: float  # root of the mean square of the differences
    flipped_pixels: float  # fraction of the pixels with a channel that errs by more than FLIP
    gradient_relative_error: float  # ||g - g*|| / ||g*||, of the raw parameter where it is largest
    gradient_worst: str  # the name of that parameter
    # between all gradients in a row, each parameter's divided by its ||g*|| first, so that no unit
    # outweighs the others
    gradient_cosine: float


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
    """Returns how far `candidate` is from `truth`.

    A parameter whose true gradient is zero everywhere (the higher harmonics at SH degree 0) takes
    no part. A candidate that is not finite has infinite errors and a cosine of 0.
    """
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
