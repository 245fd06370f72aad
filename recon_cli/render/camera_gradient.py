"""The gradient of a loss for the motion of a camera, from the gradients of the Gaussians.

This one works with every backend and device; `recon_cli.render.numba.step.camera_gradient` is the
same on the threads of the numba backend.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0, Splats


def camera_gradient(
    splats: Splats, gradients: Splats, camera: Camera, sh_degree: int
) -> NDArray[np.float64]:
    """Returns the gradient [6] of a loss for a further turn (rad) and move (world units).

    A turn w is a rotation vector about the camera's own centre and a move v is of that centre, both
    in world axes: C' = exp(w) C for the camera-to-world rotation, c' = c + v. The gradients of the
    Gaussians are enough, because a picture stays the same when camera and scene move together:

        move   dL/dv = - sum dL/dmean
        turn   dL/dw = - sum [(mean - c) x dL/dmean + torque(quat) + torque(sh)]

    A scene that turns takes its orientations along, q' = (1, w/2) q, so that with q = (s, u) and
    its gradient (a, b) torque(quat) = (s b - a u + u x b) / 2; and its colours: what was seen along
    d is seen along exp(w) d. Turning the harmonics undoes just what the turn of the direction d to
    the mean does to the colour, and dL/dmean holds the latter, so that
    torque(sh) = - d x d/dd sum_k p_k Y_k(d), with p_k = sum over channels of sh_rest_k dL/dcolour,
    and dL/dcolour = dL/dsh_dc / SH_C0.

    Sums over Gaussians are taken in float64 and in a fixed order, for any number of threads.

    `gradients` are those of `splats` as rendered with `camera`; sh_rest is not read.
    """
    rows = torch.nonzero(gradients.sh_dc.any(dim=1) | gradients.means.any(dim=1))[:, 0]
    offsets = splats.means.detach()[rows].double() - torch.from_numpy(camera.center).to(
        splats.means.device)
    pull = gradients.means[rows].double()
    torque = torch.linalg.cross(offsets, pull) + _quat_torque(
        splats.quats.detach()[rows].double(), gradients.quats[rows].double())
    degree = min(sh_degree, splats.sh_degree)
    colored = rows < len(splats.sh_rest)  # the first ones; the others have no harmonics
    if degree > 0 and bool(colored.any()):
        torque[colored] -= _color_torque(
            offsets[colored], splats.sh_rest.detach()[rows[colored]],
            gradients.sh_dc[rows[colored]] / SH_C0, degree)
    sums = torch.cat([torque, pull], dim=1).cpu().numpy().sum(axis=0)
    return np.asarray(-sums)


def _quat_torque(quats: Tensor, pull: Tensor) -> Tensor:
    """Returns the gradients [N, 3] of turning quaternions [N, 4] with gradients [N, 4]."""
    s, u, a, b = quats[:, :1], quats[:, 1:], pull[:, :1], pull[:, 1:]
    torque: Tensor = (s * b - a * u + torch.linalg.cross(u, b)) / 2
    return torque


def _color_torque(offsets: Tensor, sh_rest: Tensor, pull: Tensor, degree: int) -> Tensor:
    """Returns the gradients [N, 3] of turning the `offsets` [N, 3] from camera to colours."""
    directions = torch.nn.functional.normalize(offsets, dim=1).requires_grad_()
    basis = basis_rest(directions, degree)
    weights = (sh_rest[:, : basis.shape[1]] * pull[:, None]).sum(dim=2).double()
    (along,) = torch.autograd.grad(basis, directions, weights)
    torque: Tensor = torch.linalg.cross(directions.detach(), along)
    return torque
