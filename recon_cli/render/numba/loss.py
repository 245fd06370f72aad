"""L1 and D-SSIM with their gradient, in two passes over the rows of an image.

    L = (1 - w) mean |x - y| + w (1 - mean SSIM(x, y))            (Kerbl et al. 2023, eq. 7)
    SSIM = a1 a2 / (b1 b2),  a1 = 2 mx my + C1,  a2 = 2 cov + C2,
                             b1 = mx^2 + my^2 + C1,  b2 = var x + var y + C2   (Wang et al. 2004)

with a Gaussian window of 11 taps, sigma 1.5, and zeros beyond the border. Only var x + var y is
needed, so four maps are blurred; the gradient blurs three maps of derivatives with the same window.
Channels are interleaved: a horizontal tap is three numbers away.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    absolute, broadcast, fetch_add, fill, fma, lane_numbers, load, load_bytes, select, store, total)
from recon_cli.kernels.thread_pool import SCRATCH_FLOATS, pool
from recon_cli.scene.train_view import BORDER, SSIM_C1, SSIM_C2, SSIM_SIGMA

CHANNELS = 3
_REACH = BORDER * CHANNELS  # numbers to the outermost tap
_ROWS = 4  # rows that are blurred together: each row of the images is read for all four
_COLUMNS = 256  # numbers of a row that are blurred at a time: all stays in the first-level cache
_WIDTH = LANES + _REACH + _COLUMNS + _REACH + LANES  # of a row of blurred numbers with its margins
C1, C2 = np.float32(SSIM_C1), np.float32(SSIM_C2)
_STEP = np.float32(1 / 255)
MAPS = 3
MOMENTS = 4  # planes of a row in scratch
assert _ROWS * MOMENTS * _WIDTH <= SCRATCH_FLOATS
MIN_WIDTH = -(-LANES // CHANNELS)  # pixels; a row must fill one vector


def taps() -> NDArray[np.float32]:
    """Returns the window, [11], of sum 1."""
    window = np.exp(-0.5 * (np.arange(-BORDER, BORDER + 1) / SSIM_SIGMA) ** 2)
    normalised: NDArray[np.float32] = (window / window.sum()).astype(np.float32)
    return normalised


_PAD = _ROWS - 1  # zeros at both ends of the window: what lies beyond a row's reach weighs nothing
_WINDOW = np.pad(taps(), _PAD)


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
    pool.run(similarity, image, truth, width, height, _WINDOW, maps, similar)
    pool.run(loss_gradient, image, truth, width, height, _WINDOW, maps, ssim_weight, gradient,
             apart)
    ssim, l1 = float(similar.sum()) / size, float(apart.sum()) / size
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)


@inlined
def blur_row(scratch, plane, column, window):
    """Returns one plane blurred along the row, LANES numbers from `column` of the block on."""
    at = plane * _WIDTH + LANES + column
    result = broadcast(window, _PAD) * load(scratch, at)
    for k in range(1, 2 * BORDER + 1):
        result = fma(broadcast(window, _PAD + k), load(scratch, at + CHANNELS * k), result)
    return result


@inlined
def clear(scratch, planes):
    """Writes zeros where the block's margins may lie beyond the image."""
    for plane in range(planes):
        for i in range(0, _WIDTH, LANES):
            store(scratch, plane * _WIDTH + min(i, _WIDTH - LANES), fill(0.0))


@inlined
def keep_rows(scratch, plane, to, a, b, c, d):
    """Writes one number of each of the four rows; a row has MOMENTS planes."""
    store(scratch, plane * _WIDTH + to, a)
    store(scratch, (MOMENTS + plane) * _WIDTH + to, b)
    store(scratch, (2 * MOMENTS + plane) * _WIDTH + to, c)
    store(scratch, (3 * MOMENTS + plane) * _WIDTH + to, d)


@inlined
def moments_down(image, truth, top, height, n, column, window, scratch, to):
    """Blurs x, y, x^2 + y^2 and x y down LANES columns, for the four rows from `top` on."""
    x0, x1, x2, x3 = fill(0.0), fill(0.0), fill(0.0), fill(0.0)
    t0, t1, t2, t3 = x0, x0, x0, x0
    s0, s1, s2, s3 = x0, x0, x0, x0
    p0, p1, p2, p3 = x0, x0, x0, x0
    for y in range(max(top - BORDER, 0), min(top + _ROWS + BORDER, height)):
        x, t = load(image, y * n + column), load_bytes(truth, y * n + column) * _STEP
        squares, product = fma(x, x, t * t), x * t
        k = y - top + BORDER + _PAD  # tap of the first row; one less for each row below
        w0, w1 = broadcast(window, k), broadcast(window, k - 1)
        w2, w3 = broadcast(window, k - 2), broadcast(window, k - 3)
        x0, x1, x2, x3 = fma(w0, x, x0), fma(w1, x, x1), fma(w2, x, x2), fma(w3, x, x3)
        t0, t1, t2, t3 = fma(w0, t, t0), fma(w1, t, t1), fma(w2, t, t2), fma(w3, t, t3)
        s0, s1 = fma(w0, squares, s0), fma(w1, squares, s1)
        s2, s3 = fma(w2, squares, s2), fma(w3, squares, s3)
        p0, p1 = fma(w0, product, p0), fma(w1, product, p1)
        p2, p3 = fma(w2, product, p2), fma(w3, product, p3)
    keep_rows(scratch, 0, to, x0, x1, x2, x3)
    keep_rows(scratch, 1, to, t0, t1, t2, t3)
    keep_rows(scratch, 2, to, s0, s1, s2, s3)
    keep_rows(scratch, 3, to, p0, p1, p2, p3)


@inlined
def map_down(maps, base, plane, top, height, n, column, window, scratch, to):
    """Blurs one map, from `base` on, down LANES columns, for the four rows from `top` on."""
    a, b, c, d = fill(0.0), fill(0.0), fill(0.0), fill(0.0)
    for y in range(max(top - BORDER, 0), min(top + _ROWS + BORDER, height)):
        value = load(maps, base + y * n + column)
        k = y - top + BORDER + _PAD
        a, b = fma(broadcast(window, k), value, a), fma(broadcast(window, k - 1), value, b)
        c, d = fma(broadcast(window, k - 2), value, c), fma(broadcast(window, k - 3), value, d)
    keep_rows(scratch, plane, to, a, b, c, d)


@kernel
def similarity(counter, image, truth, width, height, window, maps, row_sums, scratch):
    """Writes SSIM's derivatives and the sum of SSIM of each row.

    `image` [H * W * 3] is float32, `truth` uint8; `window` holds the taps with _PAD zeros at both
    ends. Written are `maps` [3 * H * W * 3], the derivatives by mean, second moment and product,
    and `row_sums` [H] float64, zeros before.
    """
    n = CHANNELS * width
    size = n * height
    while True:
        top = fetch_add(counter, 0, 1) * _ROWS
        if top >= height:
            break
        for c0 in range(0, n, _COLUMNS):
            c1 = min(c0 + _COLUMNS, n)
            origin = c0 - _REACH - LANES  # column of the first number in scratch
            if origin < 0 or c1 + _REACH > n:  # the block before left its numbers there
                clear(scratch, _ROWS * MOMENTS)
            low, high = max(origin, 0), min(c1 + _REACH, n)
            for i in range(low, high, LANES):
                column = min(i, high - LANES)
                moments_down(image, truth, top, height, n, column, window, scratch, column - origin)
            for r in range(min(_ROWS, height - top)):
                row_sums[top + r] += compare_row(
                    scratch, MOMENTS * r, c0, c1, n, window, maps, (top + r) * n, size)


@inlined
def compare_row(scratch, plane, c0, c1, n, window, maps, base, size):
    """Writes the derivatives of one row of a block; returns its sum of SSIM."""
    summed = fill(0.0)
    for i in range(c0, c1, LANES):
        column = min(i, n - LANES)
        at, to = column - c0, base + column
        mx, my = blur_row(scratch, plane, at, window), blur_row(scratch, plane + 1, at, window)
        squares = blur_row(scratch, plane + 2, at, window)
        products = blur_row(scratch, plane + 3, at, window)
        means = fma(mx, mx, my * my)
        a1, a2 = 2.0 * mx * my + C1, 2.0 * (products - mx * my) + C2
        b1, b2 = means + C1, (squares - means) + C2
        per_b = 1.0 / (b1 * b2)
        ssim = a1 * a2 * per_b
        by_square, by_product = -ssim * b1 * per_b, 2.0 * a1 * per_b
        store(maps, to, 2.0 * (my * a2 - mx * ssim * b2) * per_b - 2.0 * mx * by_square
              - my * by_product)
        store(maps, size + to, by_square)
        store(maps, 2 * size + to, by_product)
        fresh = lane_numbers() >= np.float32(i - column)  # the others were counted
        summed = summed + select(fresh, ssim, 0.0)
    return total(summed)


@kernel
def loss_gradient(counter, image, truth, width, height, window, maps, ssim_weight, gradient,
                  row_sums, scratch):
    """Writes dL/dimage, [H * W * 3], and the sum of |x - y| of each row, [H] float64."""
    n = CHANNELS * width
    size = n * height
    by_l1, by_ssim = np.float32((1 - ssim_weight) / size), np.float32(-ssim_weight / size)
    while True:
        top = fetch_add(counter, 0, 1) * _ROWS
        if top >= height:
            break
        for c0 in range(0, n, _COLUMNS):
            c1 = min(c0 + _COLUMNS, n)
            origin = c0 - _REACH - LANES
            if origin < 0 or c1 + _REACH > n:  # the block before left its numbers there
                clear(scratch, _ROWS * MOMENTS)
            low, high = max(origin, 0), min(c1 + _REACH, n)
            for i in range(low, high, LANES):
                column = min(i, high - LANES)
                for plane in range(MAPS):
                    map_down(maps, plane * size, plane, top, height, n, column, window, scratch,
                             column - origin)
            for r in range(min(_ROWS, height - top)):
                row_sums[top + r] += slope_row(
                    scratch, MOMENTS * r, c0, c1, n, window, image, truth, (top + r) * n, by_l1,
                    by_ssim, gradient)


@inlined
def slope_row(scratch, plane, c0, c1, n, window, image, truth, base, by_l1, by_ssim, gradient):
    """Writes the gradient of one row of a block; returns its sum of |x - y|."""
    summed = fill(0.0)
    for i in range(c0, c1, LANES):
        column = min(i, n - LANES)
        at, to = column - c0, base + column
        x, t = load(image, to), load_bytes(truth, to) * _STEP
        slope = blur_row(scratch, plane, at, window)
        slope = fma(2.0 * x, blur_row(scratch, plane + 1, at, window), slope)
        slope = fma(t, blur_row(scratch, plane + 2, at, window), slope)
        off = x - t
        sign = select(off > 0.0, 1.0, select(off < 0.0, -1.0, fill(0.0)))
        store(gradient, to, fma(by_ssim, slope, by_l1 * sign))
        fresh = lane_numbers() >= np.float32(i - column)
        summed = summed + select(fresh, absolute(off), 0.0)
    return total(summed)
