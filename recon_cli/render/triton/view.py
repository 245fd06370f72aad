"""What kernels know of a camera: numbers in float64 on the device, by place."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor

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
