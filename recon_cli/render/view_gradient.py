"""The gradient of a loss for every number of a camera, from what a backend sums for each ellipse.

The projection of the Gaussians that were drawn is computed once more, by autograd in float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render.contract import DILATION, EllipseGradients
from recon_cli.render.torch.blocks import gradients_of, whitening_factors
from recon_cli.render.torch.projection import colors_from_sh, covariances, project_rows
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


@dataclass(frozen=True, eq=False)
class TensorCamera:
    """A pinhole camera of tensors; see `Camera`."""

    width: int
    height: int
    viewmat: Tensor  # [4, 4]
    intrinsics: Tensor  # [3, 3]

    @property
    def fx(self) -> Tensor:
        """Focal length in pixels."""
        return self.intrinsics[0, 0]

    @property
    def fy(self) -> Tensor:
        """Focal length in pixels."""
        return self.intrinsics[1, 1]

    @property
    def cx(self) -> Tensor:
        """Principal point in pixels."""
        return self.intrinsics[0, 2]

    @property
    def cy(self) -> Tensor:
        """Principal point in pixels."""
        return self.intrinsics[1, 2]

    @property
    def center(self) -> Tensor:
        """The optical centre in world coordinates, [3]."""
        center: Tensor = torch.linalg.inv(self.viewmat)[:3, 3]
        return center

    @staticmethod
    def from_camera(camera: Camera, like: Tensor) -> TensorCamera:
        """Returns a camera on the device and in the precision of a tensor."""
        return TensorCamera(camera.width, camera.height, torch.from_numpy(camera.viewmat).to(like),
                            torch.from_numpy(camera.K).to(like))

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the pixels [P, 2] and depths [P] of points [P, 3] in the world; differentiable.

        Unlike `Camera.project` it marks nothing: who calls it looks at the depths.
        """
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depths = local[:, 2]
        focal = torch.stack([self.fx, self.fy])
        return local[:, :2] / depths[:, None] * focal + self.intrinsics[:2, 2], depths


def view_gradient(
    splats: Splats, camera: TensorCamera, sh_degree: int, ellipses: EllipseGradients,
    dilation: float = DILATION,
) -> tuple[Tensor, Tensor]:
    """Returns the gradients of viewmat [4, 4] and intrinsics [3, 3], float64.

    Args:
        splats: what was rendered.
        camera: by which; its numbers are taken for independent of each other.
        sh_degree: as in `recon_cli.render.registry.render`.
        ellipses: what the backward pass wrote with `Statistics.keep_ellipses`.
        dilation: pixels^2 added to the covariance on the image.
    """
    ids, degree = ellipses.ids, min(sh_degree, splats.sh_degree)
    means, quats, log_scales = (
        tensor.detach()[ids].double()
        for tensor in (splats.means, splats.quats, splats.log_scales))
    with torch.enable_grad():
        viewmat = camera.viewmat.detach().double().requires_grad_()
        intrinsics = camera.intrinsics.detach().double().requires_grad_()
        exact = TensorCamera(camera.width, camera.height, viewmat, intrinsics)
        means2d, directions, depths = project_rows(means, quats, exact)
        outputs = [means2d, directions, depths]
        cov2d, det = covariances(directions, log_scales, dilation)
        by_mean, by_direction, _ = gradients_of(
            ellipses.moments, whitening_factors(cov2d, det), directions.detach(), log_scales,
            dilation)
        gradients = [by_mean, by_direction, ellipses.depths.double()]
        if degree > 0:  # else a colour does not depend on the camera
            colored = ids < len(splats.sh_rest)
            rows = torch.where(colored, colored.cumsum(0) - 1, len(ids))
            outputs.append(colors_from_sh(
                means - exact.center, splats.sh_dc.detach()[ids].double(),
                splats.sh_rest.detach()[ids[colored]].double(), rows, degree))
            gradients.append(ellipses.colors.double())
        found = torch.autograd.grad(
            outputs, [viewmat, intrinsics], gradients, allow_unused=True)
    return tuple(  # type: ignore[return-value]
        torch.zeros_like(leaf) if gradient is None else gradient
        for leaf, gradient in zip((viewmat, intrinsics), found, strict=True))
