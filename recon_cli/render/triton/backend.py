"""The triton backend behind the contract: float32, differentiable by autograd."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from recon_cli.render.contract import RenderOutput, Statistics
from recon_cli.render.triton.gaussian import camera_buffer
from recon_cli.render.triton.passes import (
    BackwardOptions,
    ViewInput,
    build_tile_lists,
    composite_tiles,
    composite_tiles_backward,
    ellipse_gradients,
    project_splats,
    project_splats_backward,
)
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats


def render(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
    mask: Tensor | None = None,
) -> RenderOutput:
    """Renders by the contract; see `recon_cli.render.registry.render`.

    Raises ValueError unless the splats are float32.
    """
    if splats.means.dtype != torch.float32:
        raise ValueError(
            f"the triton backend takes float32, not {splats.means.dtype}; the torch backend takes "
            "both")
    statistics = Statistics.zeros(splats.means)
    tensors = list(splats.parameters().values())
    if min(sh_degree, splats.sh_degree) == 0:
        tensors[5] = tensors[5].detach()  # not used by the image
    counting = None if mask is None else mask.contiguous().to(torch.uint8)
    rgb, alpha, depth = _TritonRender.apply(
        background, camera, TERMS[min(sh_degree, splats.sh_degree)], scores, counting, statistics,
        *tensors)
    return RenderOutput(rgb, alpha, depth, statistics)


class _TritonRender(torch.autograd.Function):
    """All kernels of a view as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any, background: Tensor, camera: Camera, terms: int, scores: bool,
        counting: Tensor | None, statistics: Statistics, *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.set_materialize_grads(False)  # a loss of colours alone takes less
        splats = Splats(*(tensor.contiguous() for tensor in tensors))
        view = camera_buffer(camera, background.device)
        projected = project_splats(ViewInput(splats, view, terms))
        # the one wait for the device: how much memory the instances take
        instances, statistics.broken = torch.stack(
            [projected.ends[-1], projected.broken.sum()]).tolist()
        statistics.radii = projected.radii
        lists = build_tile_lists(projected, projected.ends.int(), camera, view, instances)
        background = background.contiguous()
        image = composite_tiles(
            lists, camera, background, counting, statistics if scores else None,
            keep=any(ctx.needs_input_grad))
        ctx.save_for_backward(*splats.parameters().values(), view, background)
        # the outputs themselves would hold their own graph, and with it everything here, for ever
        detached = replace(image, rgb=image.rgb.detach(), alpha=image.alpha.detach(),
                           depth=image.depth.detach())
        ctx.rest = lists, detached, statistics, terms, scores, counting
        return image.rgb, image.alpha, image.depth

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor | None, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        *tensors, view, background = ctx.saved_tensors
        lists, image, statistics, terms, scores, counting = ctx.rest
        splats, plain = Splats(*tensors), grad_alpha is None and grad_depth is None
        options = BackwardOptions(plain=plain, details=scores, loo=scores)
        grad_rgb = torch.zeros_like(image.rgb) if grad_rgb is None else grad_rgb.contiguous()
        if not plain:
            grad_alpha, grad_depth = (
                torch.zeros_like(image.alpha) if gradient is None else gradient.contiguous()
                for gradient in (grad_alpha, grad_depth))
        sums = composite_tiles_backward(
            lists, image, background, counting, options, grad_rgb, grad_alpha, grad_depth)
        gradients = splats.map(torch.empty_like)
        project_splats_backward(
            ViewInput(splats, view, terms), lists, sums, options, gradients, statistics)
        if statistics.keep_ellipses:
            statistics.ellipses = ellipse_gradients(lists, sums, plain=plain)
        grad_background = None
        if ctx.needs_input_grad[0]:
            grad_background = (grad_rgb * (1 - image.alpha)[..., None]).sum((0, 1))
        return (grad_background, None, None, None, None, None, *gradients.parameters().values())
