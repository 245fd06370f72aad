"""The torch backend: a vectorized tile rasterizer for any device, in float32 or float64.

Tiles are taken in groups of similar length and composited in blocks; see `blocks`. The backward
pass evaluates the blocks again, back to front, so that memory does not grow with the pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from recon_cli.render.contract import (
    ALPHA_MAX,
    DILATION,
    TILE,
    EllipseGradients,
    RenderOutput,
    Statistics,
)
from recon_cli.render.torch.binning import Instances, bin_to_tiles
from recon_cli.render.torch.blocks import (
    CHANNELS,
    DEPTH,
    PIXELS,
    InstanceLists,
    Scratch,
    TileBlock,
    alphas,
    build_table,
    composite,
    gradients_of,
    pixel_monomials,
    whiten_moments,
    whitening_of,
)
from recon_cli.render.torch.projection import Projection, project
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


def render(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
    mask: Tensor | None = None, dilation: float = DILATION,
) -> RenderOutput:
    """Renders by the contract; see `recon_cli.render.registry.render`.

    `dilation` is what is added to the covariance on the image, pixels^2.
    """
    projection = project(splats, camera, sh_degree, dilation)
    with torch.no_grad():
        instances = bin_to_tiles(projection, camera.width, camera.height)
        statistics = Statistics.zeros(splats.means)
        statistics.broken = projection.broken
        a, b, c = projection.cov2d.unbind(-1)
        longest = (a + c) / 2 + (((a - c) / 2) ** 2 + b * b).sqrt()
        statistics.radii[projection.ids] = 3 * longest.sqrt()
    # log sigmoid keeps its gradient where the sigmoid has rounded to 1
    log_opacities = torch.nn.functional.logsigmoid(splats.logit_opacities[projection.ids])
    channels = torch.cat([projection.colors, projection.depths[:, None]], dim=-1)
    rgb, depth, alpha = _Rasterize.apply(  # type: ignore[no-untyped-call]
        _View(projection, instances, (camera.height, camera.width), statistics, scores, mask),
        projection.means2d, projection.directions, projection.log_scales, log_opacities, channels,
        background)
    return RenderOutput(rgb, alpha, depth, statistics)


def find_crossing(splats: Splats, camera: Camera, level: float) -> Tensor:
    """Returns which Gaussian brings T down to a level; see `registry.find_crossing`."""
    projection = project(splats, camera, 0)
    size = camera.height, camera.width
    instances = bin_to_tiles(projection, camera.width, camera.height)
    log_opacities = torch.nn.functional.logsigmoid(splats.logit_opacities[projection.ids])
    means2d = projection.means2d
    table = build_table(
        means2d, projection.cov2d, projection.det, log_opacities,
        means2d.new_zeros(len(means2d), CHANNELS - 1))
    transmittance = _to_tiles(means2d.new_ones(*size, 1), instances)[..., 0]
    rows = torch.full(transmittance.shape, -1, dtype=torch.int64, device=means2d.device)
    monomials, scratch = pixel_monomials(means2d)[:3], Scratch(means2d)
    ids = torch.nn.functional.pad(projection.ids, (0, 1), value=-1)
    lists = InstanceLists.from_instances(instances)
    for tiles in lists.groups():
        for block in lists.walk(tiles, transmittance):
            affine = whitening_of(table, block, instances.tiles_x)
            alpha = alphas(table, block, affine, monomials, scratch)
            _, after, _ = composite(alpha, block.before, scratch)
            crosses = (block.before > level) & (after[:, -1] <= level)
            first = (after <= level).to(torch.uint8).argmax(1)  # [n, 256]
            found = ids[block.rows].gather(1, first)
            rows[block.tiles] = torch.where(crosses, found, rows[block.tiles])
            transmittance[block.tiles] = after[:, -1]
    return _to_image(rows[..., None], instances, size)[..., 0]


@dataclass(frozen=True, eq=False)
class _View:
    """The inputs of compositing beside the tensors that have gradients."""

    projection: Projection
    instances: Instances
    size: tuple[int, int]  # height, width
    statistics: Statistics
    scores: bool
    mask: Tensor | None  # [H, W]


class _Rasterize(torch.autograd.Function):
    """Composites instances and carries gradients back to the projected Gaussians."""

    @staticmethod
    def forward(
        ctx: Any, view: _View, means2d: Tensor, directions: Tensor, log_scales: Tensor,
        log_opacities: Tensor, channels: Tensor, background: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        projection, instances, size = view.projection, view.instances, view.size
        table = build_table(means2d, projection.cov2d, projection.det, log_opacities, channels)
        image = means2d.new_zeros(len(instances.counts), PIXELS, CHANNELS)
        # a pixel beyond the image is stopped from the start: it counts in no statistic
        transmittance = _to_tiles(means2d.new_ones(*size, 1), instances)[..., 0]
        monomials, scratch = pixel_monomials(means2d)[:3], Scratch(means2d)
        counting = None
        if view.scores and view.mask is not None:
            counting = _to_tiles(view.mask.to(means2d)[..., None], instances)[..., 0]
        tally = _Tally(instances, means2d, counting) if view.scores else None
        lists = InstanceLists.from_instances(instances)

        def composite_group(tiles: Tensor) -> list[TileBlock]:
            blocks = []
            for block in lists.walk(tiles, transmittance):
                affine = whitening_of(table, block, instances.tiles_x)
                alpha = alphas(table, block, affine, monomials, scratch)
                odds, after, live = composite(alpha, block.before, scratch)
                transmittance[block.tiles] = after[:, -1]
                weights = odds.mul_(live)
                image[block.tiles] += weights.transpose(1, 2) @ table.channels[block.rows]
                blocks.append(block)
                if tally:
                    tally.add(block, weights)
            return blocks

        groups = [composite_group(tiles) for tiles in lists.groups()]
        if tally:
            tally.write(projection.ids, view.statistics)
        ctx.save_for_backward(
            means2d, directions, log_scales, log_opacities, channels, background, image)
        ctx.rest = view, counting, groups
        left = 1 - image[..., 4:]
        rgb = _to_image(image[..., :3] + left * background, instances, size)
        depth = _to_image(image[..., 3:4], instances, size)[..., 0]
        return rgb, depth, _to_image(image[..., 4:], instances, size)[..., 0]

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor, grad_depth: Tensor, grad_alpha: Tensor
    ) -> tuple[Tensor | None, ...]:
        means2d, directions, log_scales, log_opacities, channels, background, image = (
            ctx.saved_tensors)
        view, counting, groups = ctx.rest
        projection, instances, statistics = view.projection, view.instances, view.statistics
        table = build_table(means2d, projection.cov2d, projection.det, log_opacities, channels)
        monomials, scratch = pixel_monomials(means2d), Scratch(means2d)
        grads = torch.cat([grad_rgb, grad_depth[..., None], grad_alpha[..., None]], dim=-1)
        grads = _to_tiles(grads, instances)
        left = 1 - image[..., 4:]
        grad_background = (grads[..., :3] * left).sum((0, 1))
        # What is not covered shows the background: fold it into the channel of ones.
        grads[..., 4] -= grads[..., :3] @ background
        behind = means2d.new_zeros(len(instances.counts), PIXELS)  # sum of w (g . f) behind
        composited = left * background if view.scores else None  # colour behind, not divided by T
        features = means2d.new_zeros(len(instances.gaussians) + 1, CHANNELS + 6)
        scored = means2d.new_zeros(len(instances.gaussians) + 1, 3) if view.scores else None
        upper = means2d.new_ones(DEPTH, DEPTH).triu(1)

        def descend_group(blocks: list[TileBlock]) -> None:
            for block in reversed(blocks):
                n, k = block.rows.shape
                affine = whitening_of(table, block, instances.tiles_x)
                alpha = alphas(table, block, affine, monomials[:3], scratch)
                odds, after, live = composite(alpha, block.before, scratch)
                grad = grads[block.tiles]
                used = table.channels[block.rows]
                if composited is not None and scored is not None:
                    scored[block.positions, 2] = _leave_one_out(
                        used, odds, live, composited, block, upper[:k, :k], counting)
                shade = torch.bmm(
                    used, grad.transpose(1, 2), out=scratch.take("q", alpha.shape)).mul_(live)
                weighted = torch.mul(shade, odds, out=after)  # w (g . f)
                triangle = upper[:k, :k].expand(n, k, k)
                later = torch.baddbmm(
                    behind[block.tiles, None], triangle, weighted,
                    out=scratch.take("later", alpha.shape))
                behind[block.tiles] += weighted.sum(1)
                # dL/dalpha = T g.f - (sum behind) / (1 - alpha); zero where alpha was clamped
                unclamped = torch.threshold_(alpha.neg_(), -ALPHA_MAX, 0.0)
                slope = later.sub_(shade).mul_(unclamped.div_(1 + unclamped))  # alpha dL/dalpha
                features[block.positions, :CHANNELS] = odds.mul_(live) @ grad
                moments = slope.view(n * k, PIXELS) @ monomials.T
                features[block.positions, CHANNELS:] = whiten_moments(
                    moments.view(n, k, 6), affine).to(means2d.dtype)
                if scored is not None:
                    scored[block.positions, 0] = torch.linalg.vector_norm(slope, dim=-1).square()
                    scored[block.positions, 1] = (odds > 0).sum(-1).to(slope.dtype)

        for blocks in groups:
            descend_group(blocks)
        per_gaussian = _reduce(features, instances)
        if scored is not None:
            _write_scores(_reduce(scored, instances), per_gaussian, projection.ids, statistics)
        shape = [gradient.to(means2d.dtype) for gradient in gradients_of(
            per_gaussian[:, 5:10], table.whitening[:-1], directions, log_scales,
            projection.dilation)]
        statistics.means2d_grad[projection.ids] = shape[0]
        if statistics.keep_ellipses:
            statistics.ellipses = EllipseGradients(
                projection.ids, per_gaussian[:, 5:10], per_gaussian[:, :3], per_gaussian[:, 3])
        return None, *shape, per_gaussian[:, 10], per_gaussian[:, :4], grad_background


def _leave_one_out(
    used: Tensor, odds: Tensor, live: Tensor, composited: Tensor, block: TileBlock, upper: Tensor,
    counting: Tensor | None,
) -> Tensor:
    """Returns the block's part [n, K] of loo and moves `composited` in front of the block.

    alpha T (c - B) = odds (T_after c - T_after B), and T_after B is what is composited behind.
    """
    total = torch.zeros_like(used[..., 0])
    part = (live > 0).to(odds.dtype)
    if counting is not None:
        part *= counting[block.tiles, None]
    for channel in range(3):
        own = used[..., channel : channel + 1] * live
        weighted = own * odds
        later = torch.matmul(upper, weighted) + composited[block.tiles, None, :, channel]
        composited[block.tiles, :, channel] += weighted.sum(1)
        # `later` still counts what lies behind a stopped pixel; there the Gaussian is not part
        total += (((own - later) * odds) ** 2 * part).sum(-1)
    return total


def _write_scores(
    scored: Tensor, per_gaussian: Tensor, ids: Tensor, statistics: Statistics
) -> None:
    """Writes the statistics of the backward pass: sums [M, 3] of s^2, fragments and loo."""
    squares, count = scored[:, 0].double(), scored[:, 1].double().clamp_min(1)
    variance = squares - per_gaussian[:, 10].double().square() / count
    statistics.variance[ids] = variance.clamp_min(0).to(scored.dtype)
    statistics.loo[ids] = scored[:, 2]


class _Tally:
    """Counts hits and blend weights of the instances while they are composited.

    `like` has the dtype and device; `counting` [tiles, 256] is 1 where a pixel counts, None for
    all.
    """

    def __init__(self, instances: Instances, like: Tensor, counting: Tensor | None) -> None:
        self._instances, self._counting = instances, counting
        self._hits, self._sum, self._max = (
            like.new_zeros(len(instances.gaussians) + 1) for _ in range(3))

    def add(self, block: TileBlock, weights: Tensor) -> None:
        """Takes the blend weights [n, K, 256] of a block."""
        if self._counting is not None:
            weights = weights * self._counting[block.tiles, None]
        self._hits[block.positions] = (weights > 0).sum(-1).to(weights.dtype)
        self._sum[block.positions] = weights.sum(-1)
        self._max[block.positions] = weights.amax(-1)

    def write(self, ids: Tensor, statistics: Statistics) -> None:
        """Writes the totals of each Gaussian into `statistics`."""
        hits = _reduce(self._hits[:, None].double(), self._instances)[:, 0]
        statistics.hits[ids] = hits.round().long()
        sums = _reduce(self._sum[:, None].double(), self._instances)[:, 0]
        statistics.blend_sum[ids] = sums.to(statistics.blend_sum.dtype)
        statistics.blend_max[ids] = _reduce(self._max[:, None], self._instances, "max")[:, 0]


def _reduce(values: Tensor, instances: Instances, how: str = "sum") -> Tensor:
    """Returns values [E+1, C] of the instances in tile order reduced by Gaussian, [M, C].

    Every instance has a slot of its own in the order by Gaussian, and each run of slots is summed
    in order: no atomics, the same bits every time.
    """
    by_gaussian = torch.empty_like(values[:-1])
    by_gaussian[instances.slots] = values[:-1]
    return torch.segment_reduce(
        by_gaussian, how, lengths=instances.per_gaussian, axis=0, unsafe=True, initial=0)


def _to_image(tiles: Tensor, instances: Instances, size: tuple[int, int]) -> Tensor:
    """Returns [H, W, C] from [tiles, 256, C]."""
    shape = (instances.tiles_y, instances.tiles_x, TILE, TILE, tiles.shape[-1])
    image = tiles.reshape(shape).transpose(1, 2)
    image = image.reshape(instances.tiles_y * TILE, instances.tiles_x * TILE, -1)
    return image[: size[0], : size[1]].contiguous()


def _to_tiles(image: Tensor, instances: Instances) -> Tensor:
    """Returns [tiles, 256, C] from [H, W, C]; pixels beyond the image are zero."""
    below = instances.tiles_y * TILE - image.shape[0]
    beside = instances.tiles_x * TILE - image.shape[1]
    image = torch.nn.functional.pad(image, (0, 0, 0, beside, 0, below))
    shape = (instances.tiles_y, TILE, instances.tiles_x, TILE, image.shape[-1])
    return image.reshape(shape).transpose(1, 2).reshape(-1, PIXELS, image.shape[-1]).contiguous()
