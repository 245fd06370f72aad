"""Colours from real spherical harmonics, and their gradients, a block of Gaussians at a time.

Basis, signs and order are those of INRIA's 3DGS (after Sloan 2013, "Efficient Spherical Harmonic
Evaluation"), as in recon_cli.scene.harmonics. Coefficients are read one by one: a row is used whole
by one lane, so that it comes from the cache.
"""

from __future__ import annotations

import triton
import triton.language as tl

from recon_cli.scene.splats import SH_C0

C0 = tl.constexpr(SH_C0)
C1 = tl.constexpr(0.4886025119029199)
C20, C21, C22 = (tl.constexpr(c) for c in (
    1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
C30, C31, C32, C33, C34 = (tl.constexpr(c) for c in (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277))


@triton.jit
def basis(k: tl.constexpr, x, y, z):
    """Returns function k after the constant one, at directions of length 1."""
    if k == 0:
        return y * (-C1)
    elif k == 1:
        return z * C1
    elif k == 2:
        return x * (-C1)
    elif k == 3:
        return x * y * C20
    elif k == 4:
        return y * z * (-C20)
    elif k == 5:
        return (2.0 * z * z - x * x - y * y) * C21
    elif k == 6:
        return x * z * (-C20)
    elif k == 7:
        return (x * x - y * y) * C22
    elif k == 8:
        return y * (3.0 * x * x - y * y) * (-C30)
    elif k == 9:
        return x * y * z * C31
    elif k == 10:
        return y * (4.0 * z * z - x * x - y * y) * (-C32)
    elif k == 11:
        return z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * C33
    elif k == 12:
        return x * (4.0 * z * z - x * x - y * y) * (-C32)
    elif k == 13:
        return z * (x * x - y * y) * C34
    else:
        return x * (x * x - 3.0 * y * y) * (-C30)


@triton.jit
def slope(k: tl.constexpr, x, y, z):
    """Returns the gradient of `basis` with respect to x, y, z, taken as independent."""
    zero = x * 0.0
    if k == 0:
        return zero, zero - C1, zero
    elif k == 1:
        return zero, zero, zero + C1
    elif k == 2:
        return zero - C1, zero, zero
    elif k == 3:
        return y * C20, x * C20, zero
    elif k == 4:
        return zero, z * (-C20), y * (-C20)
    elif k == 5:
        return x * (-2.0 * C21), y * (-2.0 * C21), z * (4.0 * C21)
    elif k == 6:
        return z * (-C20), zero, x * (-C20)
    elif k == 7:
        return x * (2.0 * C22), y * (-2.0 * C22), zero
    elif k == 8:
        return x * y * (-6.0 * C30), (x * x - y * y) * (-3.0 * C30), zero
    elif k == 9:
        return y * z * C31, x * z * C31, x * y * C31
    elif k == 10:
        return (x * y * (2.0 * C32), (4.0 * z * z - x * x - 3.0 * y * y) * (-C32),
                y * z * (-8.0 * C32))
    elif k == 11:
        return (x * z * (-6.0 * C33), y * z * (-6.0 * C33),
                (6.0 * z * z - 3.0 * x * x - 3.0 * y * y) * C33)
    elif k == 12:
        return ((4.0 * z * z - 3.0 * x * x - y * y) * (-C32), x * y * (2.0 * C32),
                x * z * (-8.0 * C32))
    elif k == 13:
        return x * z * (2.0 * C34), y * z * (-2.0 * C34), (x * x - y * y) * C34
    else:
        return (x * x - y * y) * (-3.0 * C30), x * y * (6.0 * C30), zero


@triton.jit
def colors(sh_dc, sh_rest, i, here, colored, x, y, z, STRIDE: tl.constexpr, TERMS: tl.constexpr):
    """Returns red, green and blue of Gaussians i towards directions of length 1, not clamped.

    Args:
        sh_dc: [N, 3].
        sh_rest: [M, STRIDE / 3, 3].
        i: int64 rows.
        here: which of them are Gaussians.
        colored: which of them have a row in sh_rest.
        x: of the direction from the camera.
        y: of it.
        z: of it.
        STRIDE: numbers in a row of sh_rest.
        TERMS: coefficients a channel that are in use.
    """
    red = tl.load(sh_dc + 3 * i, mask=here, other=0.0) * C0 + 0.5
    green = tl.load(sh_dc + 3 * i + 1, mask=here, other=0.0) * C0 + 0.5
    blue = tl.load(sh_dc + 3 * i + 2, mask=here, other=0.0) * C0 + 0.5
    row = sh_rest + STRIDE * i
    for k in tl.static_range(TERMS):
        value = basis(k, x, y, z)
        red += value * tl.load(row + 3 * k, mask=colored, other=0.0)
        green += value * tl.load(row + 3 * k + 1, mask=colored, other=0.0)
        blue += value * tl.load(row + 3 * k + 2, mask=colored, other=0.0)
    return red, green, blue
