"""Symmetric blocks of 11 x 11 numbers, one a Gaussian: products and inverses.

A vector is four arrays: means, quaternions, logarithms of the scales, and logits.
"""

from __future__ import annotations

import math

import numpy as np

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd_functions import fetch_add
from recon_cli.render.numba.soa import BLOCK

SIZE = 11  # mean 3, quaternion 4, scales 3, logit 1
TRIANGLE = SIZE * (SIZE + 1) // 2  # numbers of a block, its lower rows in turn


@kernel
def invert(counter, blocks, scale, ridge, inverses):
    """Writes the inverses of scale * block + diag(ridge), [N * 66]; ridge is [N * 11]."""
    n = len(blocks) // TRIANGLE
    lower, inverse = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE))
    while True:
        block = fetch_add(counter, 0, 1)
        if block * BLOCK >= n:
            break
        for i in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            at = i * TRIANGLE
            for row in range(SIZE):  # Cholesky
                for column in range(row + 1):
                    entry = scale * np.float64(blocks[at + row * (row + 1) // 2 + column])
                    if row == column:
                        entry += ridge[SIZE * i + row]
                    for k in range(column):
                        entry -= lower[row, k] * lower[column, k]
                    if row == column:
                        # rounding of a sum of squares may leave less than the ridge
                        entry = math.sqrt(max(entry, 1e-3 * ridge[SIZE * i + row]))
                    else:
                        entry /= lower[column, column]
                    lower[row, column] = entry
            for column in range(SIZE):
                inverse[column, column] = 1 / lower[column, column]
                for row in range(column + 1, SIZE):
                    entry = 0.0
                    for k in range(column, row):
                        entry -= lower[row, k] * inverse[k, column]
                    inverse[row, column] = entry / lower[row, row]
            for row in range(SIZE):
                for column in range(row + 1):
                    entry = 0.0
                    for k in range(row, SIZE):
                        entry += inverse[k, row] * inverse[k, column]
                    inverses[at + row * (row + 1) // 2 + column] = entry


@kernel
def multiply_blocks(counter, blocks, means, quats, log_scales, logits):
    """Multiplies each Gaussian's vector by its block in place."""
    n = len(logits)
    x, y = np.empty(SIZE), np.empty(SIZE)
    while True:
        block = fetch_add(counter, 0, 1)
        if block * BLOCK >= n:
            break
        for i in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            at = i * TRIANGLE
            take(means, quats, log_scales, logits, i, x)
            y[:] = 0
            for row in range(SIZE):
                for column in range(row + 1):
                    y[row] += blocks[at] * x[column]
                    if column < row:
                        y[column] += blocks[at] * x[row]
                    at += 1
            put(means, quats, log_scales, logits, i, y)


@inlined
def take(means, quats, log_scales, logits, i, x):
    """Copies Gaussian i's numbers to `x` [11]."""
    for k in range(3):
        x[k], x[7 + k] = means[3 * i + k], log_scales[3 * i + k]
    for k in range(4):
        x[3 + k] = quats[4 * i + k]
    x[10] = logits[i]


@inlined
def put(means, quats, log_scales, logits, i, x):
    """Copies `x` [11] back."""
    for k in range(3):
        means[3 * i + k], log_scales[3 * i + k] = x[k], x[7 + k]
    for k in range(4):
        quats[4 * i + k] = x[3 + k]
    logits[i] = x[10]
