"""The numba backend behind the contract: float32 on the CPU, differentiable by autograd."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from recon_cli.render.contract import EXACT, Approximation, RenderOutput, Statistics
from recon_cli.render.numba.view_pass import Lease, Parameters, flat
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


def render(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
    mask: Tensor | None = None, approximation: Approximation = EXACT,
) -> RenderOutput:
    """Renders by the contract, or by a cheaper one; see `recon_cli.render.registry.render`.

    Raises:
        ValueError: the splats are not float32 on the CPU.
    """
    if splats.means.dtype != torch.float32 or splats.means.device.type != "cpu":
        raise ValueError(
            f"the numba backend takes float32 on the CPU, not {splats.means.dtype} on "
            f"{splats.means.device}; the torch backend takes both")
    statistics = Statistics.zeros(splats.means)
    tensors = list(splats.parameters().values())
    if min(sh_degree, splats.sh_degree) == 0:
        tensors[5] = tensors[5].detach()  # no part of the picture
    rgb, alpha, depth = _Render.apply(
        *tensors, background, camera, sh_degree, scores, mask, statistics, approximation)
    return RenderOutput(rgb, alpha, depth, statistics)


class _Render(torch.autograd.Function):
    """All kernels of a view as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, log_scales: Tensor, logit_opacities: Tensor,
        sh_dc: Tensor, sh_rest: Tensor, background: Tensor, camera: Camera, sh_degree: int,
        scores: bool, mask: Tensor | None, statistics: Statistics, approximation: Approximation,
    ) -> tuple[Tensor, Tensor, Tensor]:
        tensors = means, quats, log_scales, logit_opacities, sh_dc, sh_rest
        size = camera.height, camera.width
        rgb, alpha, depth = (means.new_empty(*size, 3), means.new_empty(size),
                             means.new_empty(size))
        lease = Lease()
        lease.frame.forward(
            Parameters.of(tensors), camera, flat(background).copy(), sh_degree,
            rgb=flat(rgb), alpha=flat(alpha), depth=flat(depth), radii=flat(statistics.radii),
            approximation=approximation, scores=scores,
            counting=None if mask is None else mask.contiguous().numpy())
        statistics.broken = lease.frame.broken
        if scores:
            lease.frame.tally(statistics)
        ctx.save_for_backward(*tensors)
        ctx.lease, ctx.statistics, ctx.scores = lease, statistics, scores
        # the output itself would hold its own graph, and with it the frame, for ever
        ctx.alpha = alpha.detach()
        return rgb, alpha, depth

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor, grad_alpha: Tensor, grad_depth: Tensor
    ) -> tuple[Tensor | None, ...]:
        tensors, statistics = ctx.saved_tensors, ctx.statistics
        gradients = [torch.empty_like(tensor, memory_format=torch.contiguous_format)
                     for tensor in tensors]
        ctx.lease.frame.backward(
            Parameters.of(tensors), Parameters.of(gradients), grad_rgb=flat(grad_rgb),
            grad_alpha=flat(grad_alpha), grad_depth=flat(grad_depth), details=True,
            scores=ctx.scores, means2d_grad=flat(statistics.means2d_grad),
            absolute_grad=flat(statistics.absolute_grad), variance=flat(statistics.variance),
            loo=flat(statistics.loo))
        background = None
        if ctx.needs_input_grad[6]:
            left = 1 - ctx.alpha
            background = (grad_rgb * left[..., None]).sum((0, 1))
        return (*gradients, background, None, None, None, None, None, None)
