"""(1 - w) L1 + w (1 - SSIM) and its gradient in five kernels (Kerbl et al. 2023, eq. 7).

SSIM as in `train.gradient`: 11 taps, sigma 1.5, zeros beyond the border, mean over pixels and
channels (Wang et al. 2004, eq. 13). The window is separable: two kernels go along rows, two down
columns. Each program sums its own part, and one adds the parts.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon_cli.scene.train_view import BORDER, SSIM_C1, SSIM_C2, SSIM_SIGMA

_WINDOW = [math.exp(-0.5 * (shift / SSIM_SIGMA) ** 2) for shift in range(BORDER + 1)]
_TOTAL = _WINDOW[0] + 2 * sum(_WINDOW[1:])
_BLOCK = 256  # numbers a program
_PARTS = 1024  # sums that one program adds at once
RADIUS = tl.constexpr(BORDER)
W0, W1, W2, W3, W4, W5 = (tl.constexpr(weight / _TOTAL) for weight in _WINDOW)
C1, C2 = tl.constexpr(SSIM_C1), tl.constexpr(SSIM_C2)


@triton.jit
def tap(d: tl.constexpr):
    """Returns the weight of the window at a distance."""
    if d == 0:
        return W0
    elif d == 1 or d == -1:
        return W1
    elif d == 2 or d == -2:
        return W2
    elif d == 3 or d == -3:
        return W3
    elif d == 4 or d == -4:
        return W4
    else:
        return W5


@triton.jit
def pair(image, truth, mask, at, here, MASKED: tl.constexpr):
    """Returns rendered and true values; the true ones twice where a pixel does not count."""
    y = tl.load(truth + at, mask=here, other=0).to(tl.float32) / 255.0
    x = tl.load(image + at, mask=here, other=0.0)
    if MASKED:
        x = tl.where(tl.load(mask + at // 3, mask=here, other=0) != 0, x, y)
    return x, y


@triton.jit
def blur_products(image, truth, mask, width, count, maps, MASKED: tl.constexpr,
                  BLOCK: tl.constexpr):
    """Blurs x, y, xx, yy and xy along rows into `maps` [5, H, W, 3]; `count` is 3 H W.

    x is `image` [H, W, 3], y `truth` [H, W, 3] uint8; `mask` [H, W] uint8 says which pixels count.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here, column = at < count, at // 3 % width
    zero = at.to(tl.float32) * 0.0
    m_x, m_y, xx, yy, xy = zero, zero, zero, zero, zero
    for d in tl.static_range(-RADIUS, RADIUS + 1):
        inside = here & (column + d >= 0) & (column + d < width)
        x, y = pair(image, truth, mask, at + 3 * d, inside, MASKED)
        wx, wy = x * tap(d), y * tap(d)
        m_x += wx
        m_y += wy
        xx += wx * x
        yy += wy * y
        xy += wx * y
    tl.store(maps + at, m_x, mask=here)
    tl.store(maps + count + at, m_y, mask=here)
    tl.store(maps + 2 * count + at, xx, mask=here)
    tl.store(maps + 3 * count + at, yy, mask=here)
    tl.store(maps + 4 * count + at, xy, mask=here)


@triton.jit
def similarity(maps, width, count, slopes, parts, BLOCK: tl.constexpr):
    """Blurs `maps` [5, H, W, 3] down columns; writes SSIM's slopes and the sum of each program.

    `slopes` [3, H, W, 3] are those by blurred x, xx and xy; `parts` [programs] sums of SSIM.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < count
    zero = at.to(tl.float32) * 0.0
    m_x, m_y, xx, yy, xy = zero, zero, zero, zero, zero
    for d in tl.static_range(-RADIUS, RADIUS + 1):
        to = at + 3 * d * width
        inside = here & (to >= 0) & (to < count)
        m_x += tl.load(maps + to, mask=inside, other=0.0) * tap(d)
        m_y += tl.load(maps + count + to, mask=inside, other=0.0) * tap(d)
        xx += tl.load(maps + 2 * count + to, mask=inside, other=0.0) * tap(d)
        yy += tl.load(maps + 3 * count + to, mask=inside, other=0.0) * tap(d)
        xy += tl.load(maps + 4 * count + to, mask=inside, other=0.0) * tap(d)
    a1, a2 = 2.0 * m_x * m_y + C1, 2.0 * (xy - m_x * m_y) + C2
    b1, b2 = m_x * m_x + m_y * m_y + C1, (xx - m_x * m_x) + (yy - m_y * m_y) + C2
    ssim = a1 * a2 / (b1 * b2)
    by_variance, by_covariance = -ssim / b2, 2.0 * a1 / (b1 * b2)
    by_mean = (2.0 * m_y * a2 / (b1 * b2) - 2.0 * m_x * ssim / b1
               - 2.0 * m_x * by_variance - m_y * by_covariance)
    tl.store(slopes + at, by_mean, mask=here)
    tl.store(slopes + count + at, by_variance, mask=here)
    tl.store(slopes + 2 * count + at, by_covariance, mask=here)
    tl.store(parts + tl.program_id(0), tl.sum(tl.where(here, ssim, 0.0)))


@triton.jit
def blur_slopes(slopes, width, count, maps, BLOCK: tl.constexpr):
    """Blurs three maps along rows: [3, H, W, 3] to [3, H, W, 3]."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here, column = at < count, at // 3 % width
    zero = at.to(tl.float32) * 0.0
    mean, variance, covariance = zero, zero, zero
    for d in tl.static_range(-RADIUS, RADIUS + 1):
        inside = here & (column + d >= 0) & (column + d < width)
        mean += tl.load(slopes + at + 3 * d, mask=inside, other=0.0) * tap(d)
        variance += tl.load(slopes + count + at + 3 * d, mask=inside, other=0.0) * tap(d)
        covariance += tl.load(slopes + 2 * count + at + 3 * d, mask=inside, other=0.0) * tap(d)
    tl.store(maps + at, mean, mask=here)
    tl.store(maps + count + at, variance, mask=here)
    tl.store(maps + 2 * count + at, covariance, mask=here)


@triton.jit
def gradient_of(image, truth, mask, maps, width, count, by_error, by_ssim, gradient, parts,
                MASKED: tl.constexpr, SSIM: tl.constexpr, BLOCK: tl.constexpr):
    """Blurs `maps` [3, H, W, 3] of `blur_slopes` down columns and adds the terms of the gradient.

    `by_error` and `by_ssim` are the slopes of the loss by the sums of absolute errors and of SSIM.
    Written are `gradient` [H, W, 3] and `parts` [programs], sums of absolute errors.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < count
    x, y = pair(image, truth, mask, at, here, MASKED)
    error = x - y
    slope = tl.where(error > 0.0, by_error, tl.where(error < 0.0, -by_error, 0.0))
    if SSIM:
        mean, variance, covariance = x * 0.0, x * 0.0, x * 0.0
        for d in tl.static_range(-RADIUS, RADIUS + 1):
            to = at + 3 * d * width
            inside = here & (to >= 0) & (to < count)
            mean += tl.load(maps + to, mask=inside, other=0.0) * tap(d)
            variance += tl.load(maps + count + to, mask=inside, other=0.0) * tap(d)
            covariance += tl.load(maps + 2 * count + to, mask=inside, other=0.0) * tap(d)
        slope += by_ssim * (mean + 2.0 * x * variance + y * covariance)
    if MASKED:
        slope = tl.where(tl.load(mask + at // 3, mask=here, other=0) != 0, slope, 0.0)
    tl.store(gradient + at, slope, mask=here)
    tl.store(parts + tl.program_id(0), tl.sum(tl.where(here, tl.abs(error), 0.0)))


@triton.jit(do_not_specialize=("programs", "count"))
def total_loss(similar, wrong, programs, count, ssim_weight, loss, SSIM: tl.constexpr,
               BLOCK: tl.constexpr):
    """Writes the loss, float64, from the sums of `programs` parts of an image of `count` numbers.

    `similar` and `wrong` [programs] are those of `similarity` and `gradient_of`.
    """
    lane = tl.arange(0, BLOCK)
    error, alike = lane.to(tl.float64) * 0, lane.to(tl.float64) * 0
    start = 0
    while start < programs:
        here = start + lane < programs
        error += tl.load(wrong + start + lane, mask=here, other=0.0).to(tl.float64)
        if SSIM:
            alike += tl.load(similar + start + lane, mask=here, other=0.0).to(tl.float64)
        start += BLOCK
    value = tl.sum(error) / count
    if SSIM:
        weight = tl.full([], ssim_weight, tl.float64)
        value = (1.0 - weight) * value + weight * (1.0 - tl.sum(alike) / count)
    tl.store(loss, value)


def loss_and_gradient(
    image: Tensor, truth: Tensor, ssim_weight: float, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Returns the loss, float64, and its gradient [H, W, 3]; nothing waits for the device.

    `image` [H, W, 3] is float32, `truth` [H, W, 3] uint8, both contiguous; `mask` [H, W] uint8 is
    not zero where a pixel counts, None where all do. `ssim_weight` is w in [0, 1].
    """
    count, width = image.numel(), image.shape[1]
    grid = (triton.cdiv(count, _BLOCK),)
    maps, slopes = image.new_empty(5 * count), image.new_empty(3 * count)
    similar, wrong = image.new_empty(grid), image.new_empty(grid)
    gradient, masked = torch.empty_like(image), mask is not None
    if ssim_weight > 0:
        blur_products[grid](image, truth, mask, width, count, maps, MASKED=masked, BLOCK=_BLOCK)
        similarity[grid](maps, width, count, slopes, similar, BLOCK=_BLOCK)
        blur_slopes[grid](slopes, width, count, maps, BLOCK=_BLOCK)
    gradient_of[grid](
        image, truth, mask, maps, width, count, (1 - ssim_weight) / count, -ssim_weight / count,
        gradient, wrong, MASKED=masked, SSIM=ssim_weight > 0, BLOCK=_BLOCK)
    loss = torch.empty((), dtype=torch.float64, device=image.device)
    total_loss[(1,)](
        similar, wrong, grid[0], count, ssim_weight, loss, SSIM=ssim_weight > 0, BLOCK=_PARTS)
    return loss, gradient
