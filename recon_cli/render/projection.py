"""From raw parameters to ellipses on the image plane, by plain autograd.

EWA splatting (Zwicker et al. 2002, eqs. 24 to 31) as used by 3D Gaussian Splatting (Kerbl et al.
2023, eq. 5). Works on the Gaussians that may touch the image only: a first pass without gradients
decides which, so that memory follows what is seen and not what there is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render.contract import ALPHA_MIN, DILATION, NEAR
from recon_cli.render.spherical_harmonics import colors_from_sh
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


@dataclass(frozen=True, eq=False)
class Projection:
    """M projected Gaussians, in order of depth.

    Attributes:
        ids: [M] int64 row of each in the splats.
        means2d: [M, 2] projected centres in pixels.
        cov2d: [M, 3] entries (a, b, c) of the covariance [[a, b], [b, c]], pixels^2, dilated.
        det: [M] its determinant, computed without cancellation; carries no gradient.
        opacities: [M] in (0, 1).
        colors: [M, 3] seen from this camera, at least 0.
        depths: [M] z in camera coordinates, world units.
    """

    ids: Tensor
    means2d: Tensor
    cov2d: Tensor
    det: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor


def project(splats: Splats, camera: Camera, sh_degree: int) -> Projection:
    """Returns the Gaussians that may touch the image, projected and sorted by depth.

    Culled are Gaussians nearer than NEAR, of opacity under 1/255, whose ellipse of alpha = 1/255
    misses the image, or that hold a value that is not finite.
    """
    with torch.no_grad():
        every = torch.arange(len(splats), device=splats.means.device)
        every = every[_in_front(splats, camera)]
        rough = _project_rows(splats, camera, every)
        ids = every[_touches_image(splats, rough, every, camera)]
        depths = (splats.means[ids] @ _rotation(splats, camera)[2]) + camera.viewmat[2, 3]
        ids = ids[torch.argsort(depths, stable=True)]
    means2d, cov2d, det, depths = _project_rows(splats, camera, ids)
    center = torch.as_tensor(camera.center, dtype=means2d.dtype, device=means2d.device)
    colors = colors_from_sh(
        splats.means[ids] - center, splats.sh_dc[ids], splats.sh_rest[ids], sh_degree)
    opacities = torch.sigmoid(splats.logit_opacities[ids])
    return Projection(ids, means2d, cov2d, det, opacities, colors, depths)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Returns the rotation matrices [M, 3, 3] of wxyz quaternions [M, 4] of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=1e-30).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=-1).reshape(-1, 3, 3)


def _rotation(splats: Splats, camera: Camera) -> Tensor:
    return torch.as_tensor(
        camera.viewmat[:3, :3], dtype=splats.means.dtype, device=splats.means.device)


def _in_front(splats: Splats, camera: Camera) -> Tensor:
    """Returns a mask [N]: finite, in front of the near plane and not transparent."""
    depths = (splats.means @ _rotation(splats, camera)[2]) + camera.viewmat[2, 3]
    finite = torch.isfinite(depths)
    for tensor in splats.parameters().values():
        # 0 times a finite term is 0, times any other NaN: one sum tells, and no term overflows it
        finite &= torch.isfinite((tensor[:, None] * 0).flatten(1).sum(1))
    visible: Tensor = finite & (depths > NEAR) & (splats.opacities >= ALPHA_MIN)
    return visible


def _project_rows(
    splats: Splats, camera: Camera, ids: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns means2d [M, 2], cov2d [M, 3], det [M] (detached) and depths [M] of some rows."""
    R = _rotation(splats, camera)
    t = torch.as_tensor(camera.viewmat[:3, 3], dtype=R.dtype, device=R.device)
    x, y, z = (splats.means[ids] @ R.T + t).unbind(-1)
    u, v = x / z, y / z
    means2d = torch.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], dim=-1)

    # The linearisation blows up at grazing angles: hold x/z and y/z within the image widened by
    # 15% on each side (INRIA 3DGS). clamp has zero gradient where it holds.
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    u = u.clamp(-camera.cx / camera.fx - margin_x,
                (camera.width - camera.cx) / camera.fx + margin_x)
    v = v.clamp(-camera.cy / camera.fy - margin_y,
                (camera.height - camera.cy) / camera.fy + margin_y)
    row_x = (camera.fx / z)[:, None] * (R[0] - u[:, None] * R[2])  # [M, 3], first row of J R
    row_y = (camera.fy / z)[:, None] * (R[1] - v[:, None] * R[2])
    factor = rotation_matrices(splats.quats[ids]) * splats.log_scales[ids].exp()[:, None, :]
    vx = (row_x[:, None, :] @ factor)[:, 0]  # [M, 3]; covariance = [vx; vy] [vx; vy]^T
    vy = (row_y[:, None, :] @ factor)[:, 0]
    a, b, c = (vx * vx).sum(-1), (vx * vy).sum(-1), (vy * vy).sum(-1)
    cov2d = torch.stack([a + DILATION, b, c + DILATION], dim=-1)
    with torch.no_grad():  # a c - b^2 cancels for needles; |vx x vy|^2 does not (Lagrange)
        cross = torch.linalg.cross(vx, vy)
        det = (cross * cross).sum(-1) + DILATION * (a + c + DILATION)
    return means2d, cov2d, det, z


def half_extents(cov2d: Tensor, opacities: Tensor) -> Tensor:
    """Returns half the width and height [M, 2] in pixels of the box around alpha = 1/255."""
    reach = 2 * torch.log(opacities / ALPHA_MIN).clamp_min(0)
    return (reach[:, None] * cov2d[:, [0, 2]]).sqrt()


def _touches_image(
    splats: Splats, rough: tuple[Tensor, Tensor, Tensor, Tensor], ids: Tensor, camera: Camera
) -> Tensor:
    """Returns a mask over `ids`: the box around alpha = 1/255 meets the image and is finite."""
    means2d, cov2d, det, _ = rough
    half = half_extents(cov2d, splats.opacities[ids])
    size = torch.tensor([camera.width, camera.height], dtype=half.dtype, device=half.device)
    inside = ((means2d + half > 0) & (means2d - half < size)).all(-1)
    return inside & torch.isfinite(half).all(-1) & torch.isfinite(det) & (det > 0)
