"""The real spherical harmonics that colours are made of.

Basis, signs and order are those of INRIA's 3DGS (after Sloan 2013, "Efficient Spherical Harmonic
Evaluation"), so that its .ply files show the same colours here.
"""

from __future__ import annotations

import torch
from torch import Tensor

_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
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
            _C2[2] * (xx - yy),
        ]
    if degree > 2:
        terms += [
            -_C3[0] * y * (3 * xx - yy), _C3[1] * x * y * z, -_C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -_C3[2] * x * (4 * zz - xx - yy),
            _C3[4] * z * (xx - yy), -_C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(terms, dim=-1)
