"""From raw parameters to ellipses on the image plane, by plain autograd.

EWA splatting (Zwicker et al. 2002, eqs. 24 to 31) as in 3D Gaussian Splatting (Kerbl et al. 2023,
eq. 5). A first pass without gradients decides which Gaussians may touch the image, so that memory
follows the visible Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
from torch import Tensor

from recon_cli.render.contract import ALPHA_MIN, DILATION, NEAR
from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0, Splats

# largest entry; smaller ones lose digits in float32 (denormal: 1e-38)
_QUATERNION_MIN = 1e-30


def colors_from_sh(
    offsets: Tensor,  # [V, 3] from the camera's centre to the Gaussians
    sh_dc: Tensor,  # [V, 3]
    sh_rest: Tensor,  # [M, T, 3] of all Gaussians that have such coefficients
    ids: Tensor,  # [V] rows of the Gaussians; from row M on they are of degree 0
    degree: int,  # in use, at most that of T
) -> Tensor:
    """Returns the colours [V, 3] towards the camera, clamped at 0 from below."""
    colors = SH_C0 * sh_dc + 0.5
    if degree > 0:
        colored = torch.nonzero(ids < len(sh_rest))[:, 0]
        basis = basis_rest(
            torch.nn.functional.normalize(offsets[colored], dim=-1, eps=1e-30), degree)
        used = sh_rest[ids[colored], :basis.shape[1]]
        # each row is added to once: no order of additions to depend on
        colors = colors.index_add(0, colored, (basis[:, None, :] @ used)[:, 0])
    return colors.clamp_min(0)


@dataclass(frozen=True, eq=False)
class Projection:
    """M projected Gaussians, in order of depth.

    `directions` are J W R, the Gaussian's own axes at scale one on the image; times the scales they
    are V, and the covariance is V V^T + 0.3 I. It and its determinant carry no gradient.
    """

    ids: Tensor  # [M] int64, row of each in the splats
    means2d: Tensor  # [M, 2] pixels
    directions: Tensor  # [M, 2, 3]
    log_scales: Tensor  # [M, 3]
    cov2d: Tensor  # [M, 3] entries (a, b, c) of [[a, b], [b, c]], pixels^2
    det: Tensor  # [M]
    opacities: Tensor  # [M] in (0, 1)
    colors: Tensor  # [M, 3] seen from this camera, at least 0
    depths: Tensor  # [M] z in camera coordinates, world units
    broken: int  # Gaussians that were culled because a value is not finite
    dilation: float  # pixels^2 added to the diagonal of the covariances


def project(
    splats: Splats, camera: Camera, sh_degree: int, dilation: float = DILATION
) -> Projection:
    """Returns the Gaussians that may touch the image, projected and sorted by depth.

    Culled are Gaussians nearer than NEAR, of opacity under 1/255, whose ellipse of alpha = 1/255
    misses the image, or that hold or are projected to a value that is not finite. `dilation` stands
    in place of the 0.3 of the covariance.
    """
    sh_degree = min(sh_degree, splats.sh_degree)
    with torch.no_grad():
        every = torch.arange(len(splats), device=splats.means.device)
        finite = _finite(splats, sh_degree)
        every = every[finite & _in_front(splats, camera)]
        means2d, directions, _ = project_rows(splats.means[every], splats.quats[every], camera)
        cov2d, det = covariances(directions, splats.log_scales[every], dilation)
        half = half_extents(cov2d, splats.opacities[every])
        sound = torch.isfinite(torch.cat([means2d, half, det[:, None]], dim=-1)).all(-1)
        broken = int((~finite).sum() + (~sound).sum())
        ids = every[sound & _touches_image(means2d, half, camera)]
        depths = (splats.means[ids] @ _rotation(splats, camera)[2]) + camera.viewmat[2, 3]
        ids = ids[torch.argsort(depths, stable=True)]
    means2d, directions, depths = project_rows(splats.means[ids], splats.quats[ids], camera)
    log_scales = splats.log_scales[ids]
    cov2d, det = covariances(directions, log_scales, dilation)
    center = torch.as_tensor(camera.center, dtype=means2d.dtype, device=means2d.device)
    colors = colors_from_sh(
        splats.means[ids] - center, splats.sh_dc[ids], splats.sh_rest, ids, sh_degree)
    opacities = torch.sigmoid(splats.logit_opacities[ids])
    projection = Projection(
        ids, means2d, directions, log_scales, cov2d, det, opacities, colors, depths, broken,
        dilation)
    lit = torch.isfinite(colors).all(-1)
    return projection if bool(lit.all()) else _without(projection, ~lit)


def _without(projection: Projection, dark: Tensor) -> Projection:
    """Returns the projection without the rows whose colour overflowed, a mask [M]."""
    rows = {item.name: getattr(projection, item.name) for item in fields(projection)}
    broken, dilation = rows.pop("broken") + int(dark.sum()), rows.pop("dilation")
    rows = {name: tensor[~dark] for name, tensor in rows.items()}
    return Projection(**rows, broken=broken, dilation=dilation)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Returns the rotation matrices [M, 3, 3] of wxyz quaternions [M, 4] of any length.

    A quaternion of zeros stands for no rotation and has no gradient. The largest entry is divided
    out first, as squares of small entries vanish; neither the rotation nor its gradient changes.
    """
    largest = quats.detach().abs().amax(-1, keepdim=True)
    nonzero = largest > _QUATERNION_MIN
    unrotated = quats.new_tensor([1.0, 0, 0, 0])
    quats = torch.where(nonzero, quats / largest.where(nonzero, 1.0), unrotated)
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=-1).reshape(-1, 3, 3)


def _rotation(splats: Splats, camera: Camera) -> Tensor:
    return torch.as_tensor(
        camera.viewmat[:3, :3], dtype=splats.means.dtype, device=splats.means.device)


def _finite(splats: Splats, sh_degree: int) -> Tensor:
    """Returns a mask [N]: every value that an image of this degree uses is finite."""
    used = splats.parameters() | {"sh_rest": splats.sh_rest[:, : (sh_degree + 1) ** 2 - 1]}
    finite = torch.ones(len(splats), dtype=torch.bool, device=splats.means.device)
    for tensor in used.values():
        # 0 times a finite term is 0, times any other NaN: one sum tells, and no term overflows it
        finite[: len(tensor)] &= torch.isfinite((tensor[:, None] * 0).flatten(1).sum(1))
    return finite


def _in_front(splats: Splats, camera: Camera) -> Tensor:
    """Returns a mask [N]: in front of the near plane and not transparent."""
    depths = (splats.means @ _rotation(splats, camera)[2]) + camera.viewmat[2, 3]
    visible: Tensor = (depths > NEAR) & (splats.opacities >= ALPHA_MIN)
    return visible


class Pinhole(Protocol):
    """A `Camera`, or the same with tensors, to which gradients flow."""

    @property
    def width(self) -> int: ...  # noqa: D102
    @property
    def height(self) -> int: ...  # noqa: D102
    @property
    def viewmat(self) -> Any: ...  # noqa: D102
    @property
    def fx(self) -> Any: ...  # noqa: D102
    @property
    def fy(self) -> Any: ...  # noqa: D102
    @property
    def cx(self) -> Any: ...  # noqa: D102
    @property
    def cy(self) -> Any: ...  # noqa: D102


def project_rows(means: Tensor, quats: Tensor, camera: Pinhole) -> tuple[Tensor, Tensor, Tensor]:
    """Returns means2d [M, 2], directions [M, 2, 3] and depths [M] of centres and rotations [M]."""
    R = torch.as_tensor(camera.viewmat[:3, :3], dtype=means.dtype, device=means.device)
    t = torch.as_tensor(camera.viewmat[:3, 3], dtype=R.dtype, device=R.device)
    x, y, z = (means @ R.T + t).unbind(-1)
    u, v = x / z, y / z
    means2d = torch.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], dim=-1)

    # The linearisation blows up at grazing angles: hold x/z and y/z within the image widened by
    # 15% on each side (INRIA 3DGS). clamp has zero gradient there.
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    u = u.clamp(-camera.cx / camera.fx - margin_x,
                (camera.width - camera.cx) / camera.fx + margin_x)
    v = v.clamp(-camera.cy / camera.fy - margin_y,
                (camera.height - camera.cy) / camera.fy + margin_y)
    row_x = (camera.fx / z)[:, None] * (R[0] - u[:, None] * R[2])  # [M, 3], first row of J R
    row_y = (camera.fy / z)[:, None] * (R[1] - v[:, None] * R[2])
    rows = torch.stack([row_x, row_y], dim=1)
    return means2d, rows @ rotation_matrices(quats), z


@torch.no_grad()
def covariances(
    directions: Tensor, log_scales: Tensor, dilation: float = DILATION
) -> tuple[Tensor, Tensor]:
    """Returns the dilated covariances on the image, [M, 3], and their determinants [M]."""
    vx, vy = (directions * log_scales.exp()[:, None, :]).unbind(1)
    a, b, c = (vx * vx).sum(-1), (vx * vy).sum(-1), (vy * vy).sum(-1)
    # a c - b^2 cancels for needles; |vx x vy|^2 does not (Lagrange)
    cross = torch.linalg.cross(vx, vy)
    det = (cross * cross).sum(-1) + dilation * (a + c + dilation)
    return torch.stack([a + dilation, b, c + dilation], dim=-1), det


def half_extents(cov2d: Tensor, opacities: Tensor) -> Tensor:
    """Returns half the width and height [M, 2] in pixels of the box around alpha = 1/255."""
    reach = 2 * torch.log(opacities / ALPHA_MIN).clamp_min(0)
    return (reach[:, None] * cov2d[:, [0, 2]]).sqrt()


def _touches_image(means2d: Tensor, half: Tensor, camera: Camera) -> Tensor:
    """Returns a mask [M]: the box of half extents `half` [M, 2] meets the image."""
    size = torch.tensor([camera.width, camera.height], dtype=half.dtype, device=half.device)
    return ((means2d + half > 0) & (means2d - half < size)).all(-1)
