"""What the machine could do at best, and how much of it a pair of Gaussian and pixel needs."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from recon_cli.render.numba.kernel import kernel
from recon_cli.render.numba.lane_functions import fill, fma
from recon_cli.render.numba.lane_memory import store
from recon_cli.render.numba.lanes import LANES

# Operations of an evaluated pair, counted in the inner loops of the compositing kernels: a
# multiply-add is two, a division one; comparisons, selections, integer operations, loads, and what
# is the same for all pixels of a row are none. The first number of each line is of the forward
# pass, the second of the backward pass.
_COUNT = {
    "u along the row": (2, 2),
    "log2 alpha = log2 o - u^2 - v^2": (4, 4),
    "2^x: reduction 3, polynomial of degree 5 by Estrin 11": (14, 14),
    "weight alpha T": (1, 1),
    "T (1 - alpha), T / (1 - alpha)": (2, 2),
    "red, green, blue, depth composited, or their gradients summed": (8, 8),
    "g . c": (0, 7),
    "slope g . c - R, and R moved on": (0, 3),
    "s = alpha T slope": (0, 1),
    "moments 1, u, v, uu, uv, vv of s": (0, 11),
    "statistics: size of s along x and y, s^2, hits": (0, 8),
}
FLOPS_FORWARD = sum(forward for forward, _ in _COUNT.values())
FLOPS_BACKWARD = sum(backward for _, backward in _COUNT.values())

_CHAINS = 12  # independent: two units times a latency of 4 to 6 cycles
_ITERATIONS = 2_000_000  # 3 ms on a core with AVX-512
_ATTEMPTS = 9


def counted() -> list[tuple[str, int, int]]:
    """Returns the count line by line: what, operations forward, operations backward."""
    return [(what, *numbers) for what, numbers in _COUNT.items()]


@kernel
def _multiply_add(iterations: Any, out: Any) -> None:
    x: Any = fill(0.999)
    c: Any = fill(1.0)
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11 = c, c, c, c, c, c, c, c, c, c, c, c
    for _ in range(iterations):
        s0, s1, s2, s3 = fma(s0, x, c), fma(s1, x, c), fma(s2, x, c), fma(s3, x, c)
        s4, s5, s6, s7 = fma(s4, x, c), fma(s5, x, c), fma(s6, x, c), fma(s7, x, c)
        s8, s9, s10, s11 = fma(s8, x, c), fma(s9, x, c), fma(s10, x, c), fma(s11, x, c)
    store(out, 0, s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7 + s8 + s9 + s10 + s11)


def measured_peak() -> float:
    """Returns the float32 GFLOP/s of one thread in multiply-adds alone, the best of several."""
    out = np.empty(LANES, np.float32)
    _multiply_add(1, out)  # compiles
    seconds = []
    for _ in range(_ATTEMPTS):
        start = time.perf_counter()
        _multiply_add(_ITERATIONS, out)
        seconds.append(time.perf_counter() - start)
    return 2e-9 * _ITERATIONS * _CHAINS * LANES / min(seconds)


def rate(pairs: int | None, ms: float | None) -> float | None:
    """Returns Gpairs/s; None where the pairs or their time are not known."""
    return None if pairs is None or not ms else pairs / ms / 1e6


def peak_fraction(
    gpairs_per_s: float | None, flops: int, peak_gflops: float | None, threads: int
) -> float | None:
    """Returns which part of the peak of `threads` threads the arithmetic of the pairs takes."""
    if gpairs_per_s is None or peak_gflops is None:
        return None
    return gpairs_per_s * flops / (peak_gflops * threads)
