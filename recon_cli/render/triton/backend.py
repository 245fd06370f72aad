"""The triton backend behind the contract: float32, differentiable by autograd."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from recon_cli.render.contract import RenderOutput, Statistics
from recon_cli.render.triton.ellipse import view_numbers
from recon_cli.render.triton.passes import Picture, Wanted, composited, decomposed, unprojected
from recon_cli.render.triton.tile_lists import listed, project
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats


def render(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
    mask: Tensor | None = None,
) -> RenderOutput:
    """Renders by the contract; see `recon_cli.render.registry.render`.

    Raises:
        ValueError: the splats are not float32.
    """
    if splats.means.dtype != torch.float32:
        raise ValueError(
            f"the triton backend takes float32, not {splats.means.dtype}; the torch backend takes "
            "both")
    statistics = Statistics.zeros(splats.means)
    tensors = list(splats.parameters().values())
    if min(sh_degree, splats.sh_degree) == 0:
        tensors[5] = tensors[5].detach()  # no part of the picture
    rgb, alpha, depth = _Render.apply(
        *tensors, background, camera, sh_degree, scores, mask, statistics)
    return RenderOutput(rgb, alpha, depth, statistics)


class _Render(torch.autograd.Function):
    """All kernels of a view as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, log_scales: Tensor, logit_opacities: Tensor,
        sh_dc: Tensor, sh_rest: Tensor, background: Tensor, camera: Camera, sh_degree: int,
        scores: bool, mask: Tensor | None, statistics: Statistics,
    ) -> tuple[Tensor, Tensor, Tensor]:
        splats = Splats(*(tensor.contiguous() for tensor in (
            means, quats, log_scales, logit_opacities, sh_dc, sh_rest)))
        terms = TERMS[min(sh_degree, splats.sh_degree)]
        view = view_numbers(camera, means.device)
        seen = project(splats, view, terms)
        # the one wait for the device: how much memory the instances take
        instances, statistics.broken = torch.stack([seen.ends[-1], seen.broken.sum()]).tolist()
        statistics.radii = seen.radii
        lists = listed(seen, seen.ends.int(), camera, view, instances)
        counting = None if mask is None else mask.contiguous().to(torch.uint8)
        background = background.contiguous()
        made = composited(lists, camera, background, counting, statistics if scores else None)
        # the output itself would hold its own graph, and with it everything here, for ever
        kept = Picture(made.rgb.detach(), made.alpha.detach(), made.depth.detach(), made.final,
                       made.last)
        ctx.save_for_backward(*splats.parameters().values(), view, background)
        ctx.rest = lists, kept, statistics, terms, scores, counting
        return made.rgb, made.alpha, made.depth

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor, grad_alpha: Tensor, grad_depth: Tensor
    ) -> tuple[Tensor | None, ...]:
        *tensors, view, background = ctx.saved_tensors
        lists, made, statistics, terms, scores, counting = ctx.rest
        splats, wanted = Splats(*tensors), Wanted(loo=scores)
        grad_rgb = grad_rgb.contiguous()
        sums = decomposed(
            lists, made, background, counting, wanted, grad_rgb, grad_alpha.contiguous(),
            grad_depth.contiguous())
        gradients = splats.map(torch.empty_like)
        unprojected(splats, view, lists, sums, wanted, terms, gradients, statistics)
        grad_background = (grad_rgb * (1 - made.alpha)[..., None]).sum((0, 1))
        return (*gradients.parameters().values(), grad_background, None, None, None, None, None)
