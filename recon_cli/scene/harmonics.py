"""Turning spherical harmonics with their scene: coefficients mix among those of the same degree."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658,
       0.3731763325901154, 1.445305721320277)


def basis_rest(directions: Tensor, degree: int) -> Tensor:
    """Returns the basis of degrees 1 to `degree` at unit directions [M, 3]: [M, (degree+1)^2-1]."""
    x, y, z = directions.unbind(-1)
    terms = [-_C1 * y, _C1 * z, -_C1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree > 1:
        terms += [
            _C2[0] * x * y, -_C2[0] * y * z, _C2[1] * (2 * zz - xx - yy), -_C2[0] * x * z,
            _C2[2] * (xx - yy)]
    if degree > 2:
        terms += [
            -_C3[0] * y * (3 * xx - yy), _C3[1] * x * y * z, -_C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -_C3[2] * x * (4 * zz - xx - yy),
            _C3[4] * z * (xx - yy), -_C3[0] * x * (xx - 3 * yy)]
    return torch.stack(terms, dim=-1)


_DEGREE = 3
# The 2l+1 functions of degree l are determined by their values in 2l+1 general directions. 64 of a
# Fibonacci lattice keep the least squares at a condition number under 1.03 for every degree.
_DIRECTIONS = 64


def rotation_blocks(rotation: NDArray[np.float64]) -> tuple[Tensor, ...]:
    """Returns the matrices that turn the coefficients of degrees 1, 2 and 3.

    With M of degree l and Y its row of basis functions, Y(R d) (M c) = Y(d) c for every direction
    d and every c: what was seen along d is seen along R d. M solves that in the least squares over
    fixed directions, and because Y(R d) spans the same functions as Y(d), without a residual.
    `rotation` is R [3, 3], from old to new axes. The results are orthogonal, float64.
    """
    directions = _lattice(_DIRECTIONS)
    turned = directions @ torch.from_numpy(np.asarray(rotation, np.float64)).T
    before, after = basis_rest(directions, _DEGREE), basis_rest(turned, _DEGREE)
    blocks = []
    for degree in range(1, _DEGREE + 1):
        rows = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        blocks.append(torch.linalg.lstsq(after[:, rows], before[:, rows]).solution)
    return tuple(blocks)


def rotate_sh(sh_rest: Tensor, rotation: NDArray[np.float64]) -> Tensor:
    """Returns coefficients [M, T, 3] of degrees 1 and up (T one of 0, 3, 8, 15) in turned axes.

    `rotation` [3, 3] leads from old to new axes. Computed in float64; the dtype stays.
    """
    turned, start = torch.empty_like(sh_rest), 0
    for block in rotation_blocks(rotation):
        end = start + len(block)
        if end <= sh_rest.shape[1]:
            terms = sh_rest[:, start:end].double()
            turned[:, start:end] = (block.to(sh_rest.device) @ terms).to(sh_rest.dtype)
        start = end
    return turned


def _lattice(count: int) -> Tensor:
    """Returns `count` unit directions [count, 3], float64, evenly spread (Fibonacci lattice)."""
    steps = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * steps / count
    angle = steps * math.pi * (3 - math.sqrt(5))
    ring = torch.sqrt(1 - z * z)
    return torch.stack([ring * torch.cos(angle), ring * torch.sin(angle), z], dim=-1)
