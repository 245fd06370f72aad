"""Adam over all parameters of all Gaussians in one sweep (Kingma and Ba 2015, algorithm 1).

As fast as torch's fused Adam, which is bound by the same memory, but without its OpenMP threads,
which spin after their work and take the cores from the kernels that follow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from recon_cli.kernels.kernel import kernel
from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    absolute, fetch_add, fill, fma, load, select, square_root, store)
from recon_cli.kernels.thread_pool import pool

BLOCK = 1 << 14  # numbers that a thread takes at a time
_VANISHED = np.float32(1e-37)  # moments under this are dropped: denormal numbers are slow


def step(
    values: Sequence[Tensor], gradients: Sequence[Tensor],
    moments: tuple[Sequence[Tensor], Sequence[Tensor]], rates: Sequence[float | None], *,
    count: int, betas: tuple[float, float], epsilon: float,
) -> None:
    """Takes one step of Adam in place.

    Args:
        values: flat contiguous float32 tensors on the CPU, one for each group of parameters.
        gradients: of the same sizes.
        moments: moving averages of the gradients, and of their squares, with the decays `betas`.
        rates: learning rate of each group; None leaves the group alone.
        count: steps taken, this one included.
    """
    sizes = np.array([0 if rate is None else value.numel()
                      for value, rate in zip(values, rates, strict=True)], np.int64)
    numbers = np.array([rate or 0.0 for rate in rates], np.float32)
    arrays = (tuple(tensor.numpy() for tensor in group) for group in (values, gradients, *moments))
    pool.run(adam, sizes, numbers, *arrays, *betas, 1 - betas[0] ** count, 1 - betas[1] ** count,
             epsilon, scratch=False)


@kernel
def adam(counter, sizes, rates, values, gradients, first, second, beta1, beta2, correction1,
         correction2, epsilon):
    """Moves `values` against `gradients`; each of the four is a tuple of G flat arrays.

        m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2,
        p <- p - rate (m / c1) / (sqrt(v / c2) + epsilon),  c1 = 1 - b1^t,  c2 = 1 - b2^t

    `sizes` [G] numbers of each group move, by the learning rates `rates` [G].
    """
    keep1, keep2 = np.float32(beta1), np.float32(beta2)
    add1, add2 = np.float32(1 - beta1), np.float32(1 - beta2)
    root = np.float32(1 / np.sqrt(correction2))
    tiny = np.float32(epsilon)
    while True:
        block = fetch_add(counter, 0, 1)
        group = 0
        while group < len(sizes) and block * BLOCK >= sizes[group]:
            block -= (sizes[group] + BLOCK - 1) // BLOCK
            group += 1
        if group == len(sizes):
            break
        low, high = block * BLOCK, min((block + 1) * BLOCK, sizes[group])
        rate = np.float32(rates[group] / correction1)
        p, grad, mean, square = values[group], gradients[group], first[group], second[group]
        for i in range(low, high - LANES + 1, LANES):
            g = load(grad, i)
            m = fma(keep1, load(mean, i), add1 * g)
            v = fma(keep2, load(square, i), add2 * g * g)
            m = select(absolute(m) < _VANISHED, fill(0.0), m)
            v = select(v < _VANISHED, fill(0.0), v)
            store(mean, i, m)
            store(square, i, v)
            store(p, i, load(p, i) - rate * m / fma(square_root(v), root, tiny))
        for i in range(high - (high - low) % LANES, high):  # the rest, fewer than LANES
            m = keep1 * mean[i] + add1 * grad[i]
            v = keep2 * square[i] + add2 * grad[i] * grad[i]
            mean[i] = m if abs(m) >= _VANISHED else np.float32(0)
            square[i] = v if v >= _VANISHED else np.float32(0)
            p[i] -= rate * mean[i] / (np.float32(np.sqrt(square[i])) * root + tiny)
