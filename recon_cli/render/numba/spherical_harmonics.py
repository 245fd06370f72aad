"""Real spherical harmonics of degree 1 to 3, LANES directions at a time.

Basis, signs and order are those of INRIA's 3DGS (after Sloan 2013, "Efficient Spherical Harmonic
Evaluation"), as in recon_cli.render.torch.projection.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.kernel import inlined
from recon_cli.render.numba.simd import LANES
from recon_cli.render.numba.simd_memory import load, store

C0 = np.float32(0.28209479177387814)
_C1 = np.float32(0.4886025119029199)
_C20, _C21, _C22 = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(
    0.5462742152960396)
_C30, _C31, _C32, _C33, _C34 = (np.float32(c) for c in (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277))
BASIS_FLOATS = 15 * LANES


@inlined
def write_basis(to, at, x, y, z, terms):
    """Writes the first `terms` functions after the constant one to planes of `to` from `at` on."""
    if terms < 3:
        return
    store(to, at, -_C1 * y)
    store(to, at + LANES, _C1 * z)
    store(to, at + 2 * LANES, -_C1 * x)
    if terms < 8:
        return
    xx, yy, zz = x * x, y * y, z * z
    store(to, at + 3 * LANES, _C20 * x * y)
    store(to, at + 4 * LANES, -_C20 * y * z)
    store(to, at + 5 * LANES, _C21 * (2.0 * zz - xx - yy))
    store(to, at + 6 * LANES, -_C20 * x * z)
    store(to, at + 7 * LANES, _C22 * (xx - yy))
    if terms < 15:
        return
    store(to, at + 8 * LANES, -_C30 * y * (3.0 * xx - yy))
    store(to, at + 9 * LANES, _C31 * x * y * z)
    store(to, at + 10 * LANES, -_C32 * y * (4.0 * zz - xx - yy))
    store(to, at + 11 * LANES, _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
    store(to, at + 12 * LANES, -_C32 * x * (4.0 * zz - xx - yy))
    store(to, at + 13 * LANES, _C34 * z * (xx - yy))
    store(to, at + 14 * LANES, -_C30 * x * (xx - 3.0 * yy))


@inlined
def direction_gradient(pull, at, x, y, z, terms):
    """Returns the gradient with respect to (x, y, z) of sum_k pull_k basis_k(x, y, z).

    `pull` holds planes from `at` on; x, y, z are taken as independent.
    """
    p0, p1, p2 = load(pull, at), load(pull, at + LANES), load(pull, at + 2 * LANES)
    gx, gy, gz = -_C1 * p2, -_C1 * p0, _C1 * p1
    if terms >= 8:
        p3, p4, p5 = load(pull, at + 3 * LANES), load(pull, at + 4 * LANES), load(
            pull, at + 5 * LANES)
        p6, p7 = load(pull, at + 6 * LANES), load(pull, at + 7 * LANES)
        p5, p7 = 2.0 * _C21 * p5, 2.0 * _C22 * p7
        gx = gx + _C20 * (y * p3 - z * p6) - x * p5 + x * p7
        gy = gy + _C20 * (x * p3 - z * p4) - y * p5 - y * p7
        gz = gz - _C20 * (y * p4 + x * p6) + 2.0 * z * p5
    if terms >= 15:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        p8, p9, p10 = load(pull, at + 8 * LANES), load(pull, at + 9 * LANES), load(
            pull, at + 10 * LANES)
        p11, p12 = load(pull, at + 11 * LANES), load(pull, at + 12 * LANES)
        p13, p14 = load(pull, at + 13 * LANES), load(pull, at + 14 * LANES)
        p8, p9, p10, p11 = _C30 * p8, _C31 * p9, _C32 * p10, _C33 * p11
        p12, p13, p14 = _C32 * p12, _C34 * p13, 3.0 * _C30 * p14
        gx = (gx - 6.0 * xy * p8 + yz * p9 + 2.0 * xy * p10 - 6.0 * xz * p11
              - (4.0 * zz - 3.0 * xx - yy) * p12 + 2.0 * xz * p13 - (xx - yy) * p14)
        gy = (gy - 3.0 * (xx - yy) * p8 + xz * p9 - (4.0 * zz - xx - 3.0 * yy) * p10
              - 6.0 * yz * p11 + 2.0 * xy * p12 - 2.0 * yz * p13 + 2.0 * xy * p14)
        gz = (gz + xy * p9 - 8.0 * yz * p10 + (6.0 * zz - 3.0 * xx - 3.0 * yy) * p11
              - 8.0 * xz * p12 + (xx - yy) * p13)
    return gx, gy, gz
