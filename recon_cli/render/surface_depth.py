"""Depth of the surface that Gaussians make, for meshes and measures.

The depth of a pixel is not that of a centre: a Gaussian that lies flat on a floor spans many depths
within one image. It is where the Gaussian of the median is densest along the pixel's ray (RaDe-GS,
Zhang et al. 2024, without their affine approximation).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render.contract import DILATION
from recon_cli.render.registry import find_crossing
from recon_cli.render.torch.projection import rotation_matrices
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import EXTENT_SIGMAS, Splats

# The median of what lies along a ray. Trained on a backdrop, surfaces let a seventh of it through
# instead of a twentieth. Chosen on the room "living" alone, bench_mesh.py.
_LEVEL, _LEVEL_ON_BACKDROP = 0.5, 0.6


@dataclass(frozen=True, eq=False)
class SurfaceDepth:
    """The surface in a view."""

    depth: Tensor  # [H, W] along the z axis of the camera, world units; 0 where there is none
    cosine: Tensor  # [H, W] between the ray and the thinnest axis of the Gaussian; 0 likewise


def render_surface(
    splats: Splats, camera: Camera, *, backend: str, level: float | None = None
) -> SurfaceDepth:
    """Returns the surface at which the transmittance falls to `level`, about half of its fall."""
    if level is None:
        level = _LEVEL if splats.backdrop is None else _LEVEL_ON_BACKDROP
    return surface_of(splats, camera, find_crossing(splats, camera, level, backend=backend))


@torch.no_grad()
def surface_of(
    splats: Splats,
    camera: Camera,
    rows: Tensor,  # [H, W] Gaussian of each pixel, -1 for none
) -> SurfaceDepth:
    """Returns where each pixel's ray is densest in its Gaussian.

    With A the inverse covariance and m the centre in the axes of the camera, the density along a
    ray t d is exp(-(t d - m)' A (t d - m) / 2), greatest at t = d'Am / d'Ad; z of d is 1, so that t
    is the depth. To the covariance is added what the rasterizer adds in the image.
    """
    like = splats.means
    rotation = torch.from_numpy(camera.viewmat[:3, :3]).to(like)
    means = (splats.means.double() @ rotation.double().T
             + torch.from_numpy(camera.viewmat[:3, 3]).to(like.device)).to(like)
    scales = splats.scales
    axes = rotation @ rotation_matrices(splats.quats)  # [N, 3, 3], in columns
    blur = DILATION * (means[:, 2] / camera.fx) * (means[:, 2] / camera.fy)
    # relative to the thinnest axis, so that nothing overflows in tiny units
    squared = scales.square() + blur[:, None]
    precision = squared.amin(1, keepdim=True) / squared
    A = (axes * precision[:, None]) @ axes.transpose(1, 2)
    pull = (A @ means[..., None])[..., 0]
    thinnest = axes.gather(2, scales.argmin(1)[:, None, None].expand(-1, 3, 1))[..., 0]
    table = torch.cat([
        A[:, 0], A[:, 1, 1:], A[:, 2, 2:], pull, thinnest, means[:, 2:],
        EXTENT_SIGMAS * scales.amax(1, keepdim=True)], dim=1)
    flat = rows.reshape(-1)
    (a, b, c, d, e, f, px, py, pz, nx, ny, nz, z, reach) = table[flat.clamp_min(0)].T
    shape = camera.height, camera.width
    x = ((torch.arange(shape[1], device=like.device) + 0.5 - camera.cx) / camera.fx).to(like)
    y = ((torch.arange(shape[0], device=like.device) + 0.5 - camera.cy) / camera.fy).to(like)
    x, y = x.expand(shape).reshape(-1), y[:, None].expand(shape).reshape(-1)
    density = x * (a * x + 2 * (b * y + c)) + y * (d * y + 2 * e) + f
    depth = (x * px + y * py + pz) / density
    depth = torch.minimum(torch.maximum(depth, z - reach), z + reach).clamp_min(0)
    cosine = (x * nx + y * ny + nz).abs() / (x * x + y * y + 1).sqrt()
    there = flat >= 0
    return SurfaceDepth(
        torch.where(there, depth, 0).reshape(shape), torch.where(there, cosine, 0).reshape(shape))
