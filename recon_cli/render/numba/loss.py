"""L1 and D-SSIM with their gradient, in two sweeps over the rows of an image.

    L = (1 - w) mean |x - y| + w (1 - mean SSIM(x, y))            (Kerbl et al. 2023, eq. 7)
    SSIM = a1 a2 / (b1 b2),  a1 = 2 mx my + C1,  a2 = 2 cov + C2,
                             b1 = mx^2 + my^2 + C1,  b2 = var x + var y + C2   (Wang et al. 2004)

with a Gaussian window of 11 taps, sigma 1.5, and zeros beyond the border. Only var x + var y is
needed, so four maps are blurred. The window is symmetric, so the gradient blurs three maps of
derivatives with the same window. The images are rows of interleaved channels: a horizontal tap is
three numbers away.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.render.numba.crew import SCRATCH_FLOATS, crew
from recon_cli.render.numba.kernel import inlined, kernel
from recon_cli.render.numba.lane_functions import (
    absolute,
    fill,
    fma,
    lane_numbers,
    select,
    total,
)
from recon_cli.render.numba.lane_memory import fetch_add, load, load_bytes, spread, store
from recon_cli.render.numba.lanes import LANES

RADIUS = 5
CHANNELS = 3
_REACH = RADIUS * CHANNELS  # numbers to the outermost tap
_COLUMNS = 512  # numbers of a row that are blurred at a time: four maps fit the first-level cache
_WIDTH = LANES + _REACH + _COLUMNS + _REACH + LANES  # of a row of blurred numbers with its margins
_ROWS = 4  # rows that a thread takes at a time
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)  # for images in [0, 1]
_STEP = np.float32(1 / 255)
MAPS = 3
assert 4 * _WIDTH <= SCRATCH_FLOATS


MIN_WIDTH = -(-LANES // CHANNELS)  # pixels; a row must fill one vector


def taps() -> NDArray[np.float32]:
    """Returns the window, [11], of sum 1."""
    window = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / 1.5) ** 2)
    normalised: NDArray[np.float32] = (window / window.sum()).astype(np.float32)
    return normalised


_WINDOW = taps()


def photometric(
    image: NDArray[np.float32], truth: NDArray[np.uint8], width: int, height: int,
    ssim_weight: float, *, maps: NDArray[np.float32], gradient: NDArray[np.float32],
) -> float:
    """Returns the loss (1 - w) L1 + w (1 - SSIM) of an image and writes its gradient.

    Args:
        image: [H * W * 3].
        truth: [H * W * 3], writeable like all arrays of kernels.
        width: in pixels, at least MIN_WIDTH.
        height: in pixels.
        ssim_weight: w in [0, 1].
        maps: [3 * H * W * 3] scratch.
        gradient: [H * W * 3] out.

    Raises:
        ValueError: the image is too narrow or the sizes do not fit.
    """
    size = CHANNELS * width * height
    if width < MIN_WIDTH:
        raise ValueError(f"an image {width} pixels wide, needed at least {MIN_WIDTH}")
    if (len(image), len(truth), len(gradient), len(maps)) != (size, size, size, MAPS * size):
        raise ValueError(f"arrays that do not fit an image of {width}x{height}")
    similar, apart = np.zeros(height), np.zeros(height)
    crew.run(similarity, image, truth, width, height, _WINDOW, maps, similar)
    crew.run(loss_gradient, image, truth, width, height, _WINDOW, maps, ssim_weight, gradient,
             apart)
    ssim, l1 = float(similar.sum()) / size, float(apart.sum()) / size
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)


@inlined
def blurred_across(scratch, plane, column, window):
    """Returns one map blurred along the row, LANES numbers from `column` of the block on."""
    at = plane * _WIDTH + LANES + column
    result = spread(window, 0) * load(scratch, at)
    for k in range(1, 2 * RADIUS + 1):
        result = fma(spread(window, k), load(scratch, at + CHANNELS * k), result)
    return result


@inlined
def clear(scratch, planes):
    """Writes zeros where the block's margins may lie beyond the image."""
    for plane in range(planes):
        for i in range(0, _WIDTH, LANES):
            at = plane * _WIDTH + min(i, _WIDTH - LANES)
            store(scratch, at, fill(0.0))


@kernel
def similarity(counter, image, truth, width, height, window, maps, row_sums, scratch):
    """Writes SSIM's derivatives and the sum of SSIM of each row.

    Args:
        counter: [1] shared; groups of rows already taken.
        image: [H * W * 3] float32.
        truth: [H * W * 3] uint8.
        width: of the image in pixels, at least LANES / 3.
        height: in pixels.
        window: [11] taps.
        maps: [3 * H * W * 3] out: by mean, by second moment, by product.
        row_sums: [H] float64 out.
        scratch: of the thread.
    """
    n = CHANNELS * width
    size = n * height
    while True:
        group = fetch_add(counter, 0, 1)
        if group * _ROWS >= height:
            break
        for y in range(group * _ROWS, min((group + 1) * _ROWS, height)):
            summed = fill(0.0)
            for c0 in range(0, n, _COLUMNS):
                c1 = min(c0 + _COLUMNS, n)
                if c0 == 0 or c1 == n:
                    clear(scratch, 4)
                origin = c0 - _REACH - LANES  # column of the first number in scratch
                low, high = max(origin, 0), min(c1 + _REACH, n)
                for i in range(low, high, LANES):
                    column = min(i, high - LANES)
                    blur_down(image, truth, y, height, n, column, window, scratch,
                              column - origin)
                for i in range(c0, c1, LANES):
                    column = min(i, n - LANES)
                    fresh = lane_numbers() >= np.float32(i - column)  # the others were counted
                    at = column - c0
                    mx, my = blurred_across(scratch, 0, at, window), blurred_across(
                        scratch, 1, at, window)
                    squares = blurred_across(scratch, 2, at, window)
                    products = blurred_across(scratch, 3, at, window)
                    means = fma(mx, mx, my * my)
                    a1, a2 = 2.0 * mx * my + C1, 2.0 * (products - mx * my) + C2
                    b1, b2 = means + C1, (squares - means) + C2
                    per_b = 1.0 / (b1 * b2)
                    ssim = a1 * a2 * per_b
                    by_square = -ssim * b1 * per_b
                    by_product = 2.0 * a1 * per_b
                    by_mean = (2.0 * (my * a2 - mx * ssim * b2) * per_b - 2.0 * mx * by_square
                               - my * by_product)
                    to = y * n + column
                    store(maps, to, by_mean)
                    store(maps, size + to, by_square)
                    store(maps, 2 * size + to, by_product)
                    summed = summed + select(fresh, ssim, 0.0)
            row_sums[y] = total(summed)


@inlined
def blur_down(image, truth, y, height, n, column, window, scratch, to):
    """Blurs x, y, x^2 + y^2 and x y along LANES columns into four planes of scratch."""
    sum_x, sum_y, squares, products = fill(0.0), fill(0.0), fill(0.0), fill(0.0)
    for k in range(max(-RADIUS, -y), min(RADIUS, height - 1 - y) + 1):
        at = (y + k) * n + column
        weight = spread(window, k + RADIUS)
        x, t = load(image, at), load_bytes(truth, at) * _STEP
        weighted_x, weighted_t = weight * x, weight * t
        sum_x, sum_y = sum_x + weighted_x, sum_y + weighted_t
        squares = fma(weighted_x, x, fma(weighted_t, t, squares))
        products = fma(weighted_x, t, products)
    store(scratch, to, sum_x)
    store(scratch, _WIDTH + to, sum_y)
    store(scratch, 2 * _WIDTH + to, squares)
    store(scratch, 3 * _WIDTH + to, products)


@kernel
def loss_gradient(counter, image, truth, width, height, window, maps, ssim_weight, gradient,
                  row_sums, scratch):
    """Writes dL/dimage, [H * W * 3], and the sum of |x - y| of each row, [H] float64."""
    n = CHANNELS * width
    size = n * height
    by_l1 = np.float32((1 - ssim_weight) / size)
    by_ssim = np.float32(-ssim_weight / size)
    while True:
        group = fetch_add(counter, 0, 1)
        if group * _ROWS >= height:
            break
        for y in range(group * _ROWS, min((group + 1) * _ROWS, height)):
            summed = fill(0.0)
            for c0 in range(0, n, _COLUMNS):
                c1 = min(c0 + _COLUMNS, n)
                if c0 == 0 or c1 == n:
                    clear(scratch, MAPS)
                origin = c0 - _REACH - LANES
                low, high = max(origin, 0), min(c1 + _REACH, n)
                for i in range(low, high, LANES):
                    column = min(i, high - LANES)
                    for plane in range(MAPS):
                        down = fill(0.0)
                        for k in range(max(-RADIUS, -y), min(RADIUS, height - 1 - y) + 1):
                            at = plane * size + (y + k) * n + column
                            down = fma(spread(window, k + RADIUS), load(maps, at), down)
                        store(scratch, plane * _WIDTH + column - origin, down)
                for i in range(c0, c1, LANES):
                    column = min(i, n - LANES)
                    fresh = lane_numbers() >= np.float32(i - column)
                    at, to = column - c0, y * n + column
                    x, t = load(image, to), load_bytes(truth, to) * _STEP
                    slope = blurred_across(scratch, 0, at, window)
                    slope = fma(2.0 * x, blurred_across(scratch, 1, at, window), slope)
                    slope = fma(t, blurred_across(scratch, 2, at, window), slope)
                    off = x - t
                    sign = select(off > 0.0, 1.0, select(off < 0.0, -1.0, fill(0.0)))
                    store(gradient, to, fma(by_ssim, slope, by_l1 * sign))
                    summed = summed + select(fresh, absolute(off), 0.0)
            row_sums[y] = total(summed)
