"""The ellipse of a projected Gaussian: what both passes over the Gaussians compute.

EWA splatting (Zwicker et al. 2002, eqs. 24 to 31): V = J W R S, Sigma' = V V^T + 0.3 I. Positions
are taken in float64, for an error of the mean in pixels is an error of every alpha; shapes in
float32, in forms that do not cancel for needles.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon_cli.render.triton.compositing import LOG2E
from recon_cli.scene.camera import Camera

# rotation 0 to 8, translation 9 to 11, then
FX, FY, CX, CY = (tl.constexpr(place) for place in range(12, 16))
LEFT, RIGHT, TOP, BOTTOM = (tl.constexpr(place) for place in range(16, 20))
CENTER = tl.constexpr(20)  # and two more
WIDTH, HEIGHT = tl.constexpr(23), tl.constexpr(24)
_MARGIN = 0.15  # of the size on each side, where x/z and y/z are held (INRIA's 3DGS)


def view_numbers(camera: Camera, device: torch.device) -> Tensor:
    """Returns the numbers [25] of a camera; the copy waits for nothing."""
    margin_x, margin_y = _MARGIN * camera.width / camera.fx, _MARGIN * camera.height / camera.fy
    numbers = torch.tensor([
        *camera.viewmat[:3, :3].ravel(), *camera.viewmat[:3, 3],
        camera.fx, camera.fy, camera.cx, camera.cy,
        -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x,
        -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y,
        *camera.center, camera.width, camera.height], dtype=torch.float64)
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
    """Returns w, x, y, z of length 1, and what a gradient is multiplied by.

    Divided by the largest entry first: the squares of small entries would vanish. A quaternion of
    zeros stands for no rotation and has no gradient.
    """
    w = tl.load(quats + 4 * i, mask=here, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=here, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=here, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=here, other=0.0)
    top = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    given = top > 1e-30
    per_top = 1.0 / tl.where(given, top, 1.0)
    w, x, y, z = w * per_top, x * per_top, y * per_top, z * per_top
    w = tl.where(given, w, 1.0)
    per_length = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    return (w * per_length, x * per_length, y * per_length, z * per_length,
            tl.where(given, per_length * per_top, 0.0))


@triton.jit
def rotation(w, x, y, z):
    """Returns the nine entries of the rotation matrix of a quaternion of length 1."""
    return (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


@triton.jit
def image_axes(view, u, v, per_z):
    """Returns the two rows of J W. x/z and y/z are held near the image: at grazing angles the
    linearisation blows up."""
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
def projected_axes(a0, a1, a2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """Returns a row of J W times R."""
    return (a0 * r00 + a1 * r10 + a2 * r20, a0 * r01 + a1 * r11 + a2 * r21,
            a0 * r02 + a1 * r12 + a2 * r22)
