"""Tile blocks of the torch backend: DEPTH Gaussians over a group of tiles, as dense tensors.

Inside a tile a Gaussian is whitened: with the covariance [[a, b], [b, c]], q = u^2 + v^2 where
u = sqrt(c / det) (dx - b/c dy) and v = dy / sqrt(c). Both are affine in the pixel, so one small
matrix product evaluates them, and the gradients are moments in (u, v), which stay of order one
for needles, where the moments in (dx, dy) cancel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, DILATION, TILE, TRANSMITTANCE_MIN
from recon_cli.render.torch.binning import Instances

DEPTH = 32  # Gaussians a block: the triangular product costs DEPTH multiplications a pair
PIXELS = TILE * TILE
CHANNELS = 5  # r, g, b, depth, one
_PAIRS = {"cpu": 1 << 18, "cuda": 1 << 25}  # pairs a block: the second-level cache, the launches


@dataclass(frozen=True, eq=False)
class TileTable:
    """The inputs of the blocks, one row a Gaussian; the last row is empty and pads short lists."""

    means2d: Tensor  # [M+1, 2] float64 centres, so that offsets from a far centre keep their digits
    whitening: Tensor  # [M+1, 3] float64 factors (l11, l12, l22) of the inverse covariance
    log_opacities: Tensor  # [M+1]; -inf in the last row, whose alpha is therefore 0
    channels: Tensor  # [M+1, 5] r, g, b, depth, one


class Scratch:
    """Named buffers for the intermediate tensors of a block, allocated once.

    On a CPU the page faults of fresh half-megabyte tensors cost as much as the arithmetic.
    """

    def __init__(self, like: Tensor) -> None:
        self._like = like
        self._buffers: dict[str, Tensor] = {}

    def take(self, name: str, shape: tuple[int, ...]) -> Tensor:
        """Returns the buffer of that name as an uninitialised tensor of `shape`."""
        size = math.prod(shape)
        buffer = self._buffers.get(name)
        if buffer is None or buffer.numel() < size:
            buffer = self._buffers[name] = self._like.new_empty(max(size, DEPTH * PIXELS))
        return buffer[:size].view(shape)


@dataclass(eq=False)
class TileBlock:
    """A run of instances of some tiles."""

    tiles: Tensor  # [n] tile indices
    positions: Tensor  # [n, K] instance in tile order; E (one past the end) where a list is shorter
    rows: Tensor  # [n, K] row in the table
    before: Tensor  # [n, 256] transmittance in front of the block, kept for the backward pass


def build_table(
    means2d: Tensor,  # [M, 2]
    cov2d: Tensor,  # [M, 3]
    det: Tensor,  # [M]
    log_o: Tensor,  # [M]
    channels: Tensor,  # [M, 4]
) -> TileTable:
    """Returns the table of M projected Gaussians with its empty last row."""
    whitening = whitening_factors(cov2d, det)
    ones = torch.ones_like(log_o)[:, None]
    return TileTable(
        torch.nn.functional.pad(means2d.double(), (0, 0, 0, 1)),
        torch.nn.functional.pad(whitening, (0, 0, 0, 1)),
        torch.nn.functional.pad(log_o, (0, 1), value=-torch.inf),
        torch.nn.functional.pad(torch.cat([channels, ones], dim=-1), (0, 0, 0, 1)))


def whitening_factors(cov2d: Tensor, det: Tensor) -> Tensor:
    """Returns (l11, l12, l22) [M, 3] float64 with q = (l11 dx + l12 dy)^2 + (l22 dy)^2."""
    _, b, c = cov2d.double().unbind(-1)
    det = det.double()
    return torch.stack([(c / det).sqrt(), -b / (c * det).sqrt(), c.rsqrt()], dim=-1)


@dataclass(frozen=True, eq=False)
class InstanceLists:
    """The instances of every tile in a form that blocks are cut from."""

    counts: Tensor  # [tiles] instances of each tile
    first: Tensor  # [tiles] position of the first one
    gaussians: Tensor  # [E+1] row in the table by position; the last one is the empty row

    @staticmethod
    def from_instances(instances: Instances) -> InstanceLists:
        """Returns the lists of some instances."""
        empty_row = len(instances.per_gaussian)
        gaussians = torch.nn.functional.pad(instances.gaussians, (0, 1), value=empty_row)
        first = torch.cumsum(instances.counts, 0) - instances.counts
        return InstanceLists(instances.counts, first, gaussians)

    def groups(self) -> list[Tensor]:
        """Returns the tiles that have instances, in groups of similar length, longest first."""
        order = torch.argsort(self.counts, descending=True, stable=True)
        order = order[: int((self.counts > 0).sum())]
        size = max(1, _PAIRS[order.device.type] // (DEPTH * PIXELS))
        return list(torch.split(order, size)) if len(order) else []

    def walk(self, tiles: Tensor, transmittance: Tensor) -> Iterator[TileBlock]:
        """Yields the blocks of a group front to back, without tiles that have ended or are opaque.

        `tiles` [n] are the group, longest list first; the caller updates `transmittance` [tiles,
        256] after each block.
        """
        longest = int(self.counts[tiles[0]])
        steps = torch.arange(DEPTH, device=tiles.device)
        for start in range(0, longest, DEPTH):
            alive = self.counts[tiles] > start
            alive &= (transmittance[tiles] >= TRANSMITTANCE_MIN).any(1)
            tiles = tiles[alive]
            if len(tiles) == 0:
                return
            index = start + steps[: longest - start]
            positions = torch.where(
                index < self.counts[tiles, None], self.first[tiles, None] + index,
                len(self.gaussians) - 1)
            yield TileBlock(tiles, positions, self.gaussians[positions], transmittance[tiles])


def pixel_monomials(like: Tensor) -> Tensor:
    """Returns [6, 256]: 1, x, y, x^2, xy, y^2 at the pixel centres, from the tile's centre."""
    offset = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    x, y = offset.repeat(TILE), offset.repeat_interleave(TILE)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def whitening_of(table: TileTable, block: TileBlock, tiles_x: int) -> Tensor:
    """Returns [n, K, 5]: u = k0 + k1 x + k2 y and v = k3 + k4 y at offsets from the tile centre."""
    l11, l12, l22 = table.whitening[block.rows].unbind(-1)
    center_x = (block.tiles % tiles_x) * TILE + TILE / 2
    center_y = block.tiles.div(tiles_x, rounding_mode="floor") * TILE + TILE / 2
    mean_x, mean_y = table.means2d[block.rows].unbind(-1)
    dx, dy = center_x[:, None] - mean_x, center_y[:, None] - mean_y
    return torch.stack([l11 * dx + l12 * dy, l11, l12, l22 * dy, l22], dim=-1)


def alphas(
    table: TileTable, block: TileBlock, affine: Tensor, monomials: Tensor, scratch: Scratch
) -> Tensor:
    """Returns alpha [n, K, 256] after both thresholds: alpha = o exp(-q / 2).

    `monomials` is [3, 256]: 1, x, y at the pixels. The result lies in `scratch`.
    """
    n, k = block.rows.shape
    half = (affine * 0.5**0.5).to(monomials.dtype).reshape(n * k, 5)
    q = torch.mm(half[:, :3], monomials, out=scratch.take("q", (n * k, PIXELS)))
    q.mul_(q)
    v = torch.mm(half[:, 3:], monomials[::2], out=scratch.take("alpha", (n * k, PIXELS)))
    q.addcmul_(v, v)
    alpha = torch.sub(table.log_opacities[block.rows].reshape(n * k, 1), q, out=v).exp_()
    # threshold(x, t, 0) keeps x > t; the greatest number below 1/255 makes that x >= 1/255
    torch.threshold_(alpha.clamp_max_(ALPHA_MAX), _below(ALPHA_MIN, alpha.dtype), 0.0)
    return alpha.view(n, k, PIXELS)


@cache
def _below(value: float, dtype: torch.dtype) -> float:
    """Returns the greatest number of the dtype below `value`."""
    number = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(number, number - 1))


def composite(alpha: Tensor, before: Tensor, scratch: Scratch) -> tuple[Tensor, Tensor, Tensor]:
    """Returns odds alpha / (1 - alpha), transmittance after each Gaussian, and the same live.

    The live transmittance is 0 from the Gaussian on that would have left less than 1e-4: times
    the odds it is the blend weight alpha T, without a mask. All three lie in `scratch`.
    """
    clear = torch.neg(alpha, out=scratch.take("clear", alpha.shape)).add_(1)
    odds = torch.div(alpha, clear, out=scratch.take("odds", alpha.shape))
    after = torch.cumprod(clear, 1, out=scratch.take("after", alpha.shape)).mul_(before[:, None])
    live = clear.copy_(after)
    return odds, after, torch.threshold_(live, _below(TRANSMITTANCE_MIN, alpha.dtype), 0.0)


def whiten_moments(moments: Tensor, affine: Tensor) -> Tensor:
    """Returns the sums [n, K, 6] of s times u, v, u^2, uv, v^2, 1, with s = alpha dL/dalpha.

    `moments` are the sums of s times 1, x, y, x^2, xy, y^2 at offsets from the tile's centre.
    """
    s, sx, sy, sxx, sxy, syy = moments.double().unbind(-1)
    u0, ux, uy, v0, vy = affine.unbind(-1)
    u = u0 * s + ux * sx + uy * sy
    v = v0 * s + vy * sy
    uu = u0 * (u + ux * sx + uy * sy) + ux * ux * sxx + 2 * ux * uy * sxy + uy * uy * syy
    uv = u0 * v + v0 * (ux * sx + uy * sy) + vy * (ux * sxy + uy * syy)
    vv = v0 * (v + vy * sy) + vy * vy * syy
    return torch.stack([u, v, uu, uv, vv, s], dim=-1)


def gradients_of(
    sums: Tensor,  # [M, 5] u, v, uu, uv, vv
    whitening: Tensor,  # [M, 3]
    directions: Tensor,  # [M, 2, 3]
    log_scales: Tensor,  # [M, 3]
    dilation: float = DILATION,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the gradients of means2d [M, 2], directions [M, 2, 3] and log_scales [M, 3].

    With d = pixel - mean the inverse covariance is L^T L, and y = L^T (u, v) = Sigma^-1 d. So
    dL/dmean = sum s y, and as dL/dSigma = 1/2 sum s y y^T and Sigma = V V^T + 0.3 I,

        dL/dV = L^T M P,   dL/dlog s = diag(P^T M P),   M = sum s (u, v)(u, v)^T,   P = L V.

    P is of order one. By way of dL/dSigma the long axis of a needle would get its gradient as what
    is left of terms that are larger by the square of its length in pixels.
    """
    u, v, uu, uv, vv = sums.double().unbind(-1)
    l11, l12, l22 = whitening.unbind(-1)
    scales = log_scales.double().exp()[:, None]
    vx, vy = (directions.double() * scales).unbind(1)
    # vx - b/c vy = (0.3 vx + vy x (vx x vy)) / c, in which no long terms cancel
    c = (vy * vy).sum(-1) + dilation
    across = dilation * vx + torch.linalg.cross(vy, torch.linalg.cross(vx, vy))
    p, q = (l11 / c)[:, None] * across, l22[:, None] * vy  # the rows of P
    e = uu[:, None] * p + uv[:, None] * q
    f = uv[:, None] * p + vv[:, None] * q
    pull = torch.stack([l11[:, None] * e, l12[:, None] * e + l22[:, None] * f], dim=1)
    return torch.stack([l11 * u, l12 * u + l22 * v], dim=-1), pull * scales, e * p + f * q
