"""The ellipse and the colour of a Gaussian in a view, for both passes over the Gaussians.

EWA splatting (Zwicker et al. 2002, eqs. 24 to 31): V = J W R S, Sigma' = V V^T + 0.3 I. Positions
are in float64, because an error of the mean in pixels is an error of every alpha; shapes in
float32, in forms that do not cancel for needles. Spherical harmonics are those of
recon_cli.scene.harmonics (INRIA's 3DGS, after Sloan 2013, "Efficient Spherical Harmonic
Evaluation"); their coefficients are read one by one: a row is used whole by one lane, so that it
comes from the cache.
"""

from __future__ import annotations

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from recon_cli.kernels.viewpoint import MARGIN
from recon_cli.render.triton.compositing import LOG2E
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0

# Places in a camera buffer: rotation 0 to 8, translation 9 to 11, then
FX, FY, CX, CY = (tl.constexpr(place) for place in range(12, 16))
LEFT, RIGHT, TOP, BOTTOM = (tl.constexpr(place) for place in range(16, 20))
CENTER = tl.constexpr(20)  # and two more
WIDTH, HEIGHT = tl.constexpr(23), tl.constexpr(24)
C0 = tl.constexpr(SH_C0)
C1 = tl.constexpr(0.4886025119029199)
C20, C21, C22 = (tl.constexpr(c) for c in (
    1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
C30, C31, C32, C33, C34 = (tl.constexpr(c) for c in (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277))


def camera_buffer(camera: Camera, device: torch.device) -> Tensor:
    """Returns a camera as the numbers [25] that kernels read; the copy waits for nothing."""
    margin_x, margin_y = MARGIN * camera.width / camera.fx, MARGIN * camera.height / camera.fy
    numbers = torch.from_numpy(np.concatenate([
        camera.viewmat[:3, :3].ravel(), camera.viewmat[:3, 3],
        [camera.fx, camera.fy, camera.cx, camera.cy,
         -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x,
         -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y],
        camera.center, [camera.width, camera.height]]).astype(np.float64))
    if device.type == "cuda":
        numbers = numbers.pin_memory()
    return numbers.to(device, non_blocking=True)


@triton.jit
def position(means, view, i, here):
    """Returns the centres in the camera's coordinates, [3] of [BLOCK] float64."""
    x = tl.load(means + 3 * i, mask=here, other=0.0).to(tl.float64)
    y = tl.load(means + 3 * i + 1, mask=here, other=0.0).to(tl.float64)
    z = tl.load(means + 3 * i + 2, mask=here, other=0.0).to(tl.float64)
    return (tl.load(view) * x + tl.load(view + 1) * y + tl.load(view + 2) * z + tl.load(view + 9),
            tl.load(view + 3) * x + tl.load(view + 4) * y + tl.load(view + 5) * z
            + tl.load(view + 10),
            tl.load(view + 6) * x + tl.load(view + 7) * y + tl.load(view + 8) * z
            + tl.load(view + 11))


@triton.jit
def direction(means, view, i, here):
    """Returns the directions [3] from the camera, of length 1, and one over the distance."""
    x = tl.load(means + 3 * i, mask=here, other=0.0).to(tl.float64) - tl.load(view + CENTER)
    y = tl.load(means + 3 * i + 1, mask=here, other=0.0).to(tl.float64) - tl.load(view + CENTER + 1)
    z = tl.load(means + 3 * i + 2, mask=here, other=0.0).to(tl.float64) - tl.load(view + CENTER + 2)
    x, y, z = x.to(tl.float32), y.to(tl.float32), z.to(tl.float32)
    per_length = 1.0 / tl.sqrt(tl.maximum(x * x + y * y + z * z, 1e-37))
    return x * per_length, y * per_length, z * per_length, per_length


@triton.jit
def number(view, place: tl.constexpr):
    """Returns a number of the view in float32."""
    return tl.load(view + place).to(tl.float32)


@triton.jit
def unit_quaternion(quats, i, here):
    """Returns w, x, y, z of length 1, and the factor of a gradient.

    The largest entry is divided out first: small squares vanish. Zeros: no rotation, no gradient.
    """
    w = tl.load(quats + 4 * i, mask=here, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=here, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=here, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=here, other=0.0)
    top = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    nonzero = top > 1e-30
    per_top = 1.0 / tl.where(nonzero, top, 1.0)
    w, x, y, z = w * per_top, x * per_top, y * per_top, z * per_top
    w = tl.where(nonzero, w, 1.0)
    per_length = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    return (w * per_length, x * per_length, y * per_length, z * per_length,
            tl.where(nonzero, per_length * per_top, 0.0))


@triton.jit
def rotation(w, x, y, z):
    """Returns the nine entries of the rotation matrix of a quaternion of length 1."""
    return (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


@triton.jit
def image_axes(view, u, v, per_z):
    """Returns the two rows of J W. x/z and y/z are clamped near the image: at grazing angles
    the linearisation blows up."""
    u = tl.minimum(tl.maximum(u, number(view, LEFT)), number(view, RIGHT))
    v = tl.minimum(tl.maximum(v, number(view, TOP)), number(view, BOTTOM))
    along_x, along_y = number(view, FX) * per_z, number(view, FY) * per_z
    r20, r21, r22 = number(view, 6), number(view, 7), number(view, 8)
    return (along_x * (number(view, 0) - u * r20), along_x * (number(view, 1) - u * r21),
            along_x * (number(view, 2) - u * r22), along_y * (number(view, 3) - v * r20),
            along_y * (number(view, 4) - v * r21), along_y * (number(view, 5) - v * r22))


@triton.jit
def standard_deviations(log_scales, i, here):
    """Returns the three standard deviations, held within what float32 can square."""
    s0 = tl.load(log_scales + 3 * i, mask=here, other=0.0) * LOG2E
    s1 = tl.load(log_scales + 3 * i + 1, mask=here, other=0.0) * LOG2E
    s2 = tl.load(log_scales + 3 * i + 2, mask=here, other=0.0) * LOG2E
    return (tl.exp2(tl.minimum(tl.maximum(s0, -126.0), 126.0)),
            tl.exp2(tl.minimum(tl.maximum(s1, -126.0), 126.0)),
            tl.exp2(tl.minimum(tl.maximum(s2, -126.0), 126.0)))


@triton.jit
def project_axes(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """Returns a row of J W times R."""
    return (a0 * r00 + a1 * r10 + a2 * r20, a0 * r01 + a1 * r11 + a2 * r21,
            a0 * r02 + a1 * r12 + a2 * r22)


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

    Rows in `colored` have STRIDE numbers in sh_rest, of which TERMS a channel are in use.
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
