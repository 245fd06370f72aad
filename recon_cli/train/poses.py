"""Refinement of the training cameras during training: a twist on top of each one that was found.

It helps where cameras are off by half a pixel and more, as those of a tracker can be, and harms
better ones, as those of SfM mostly are: see `worth_a_trial`. Held-out views are scored through
their cameras as found. So that the scene does not move as a whole, the mean twist is held at 0 and
the size of the path as it was; a path that bends is not held.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.train.optimizer import SparseAdam

# First rate times steps of a camera, in units of the expected error; over the run a camera can go
# .39 of that. In a room of 100 views, 10 to 12 steps each, 3.4 left .21 of 1 degree and 3.8 left
# .11 of .3 degrees, with novel views within .02 dB of those that true cameras give.
_REACH = 4.0
_FINAL = 0.1  # of the first rate, at the end of the run; .01 left .31 of 1 degree
# Share of the scene's extent that a camera moves while it turns by a rad. A turn and a move across
# the view look alike, and 1 left a centimetre as 1.5 centimetres.
_MOVE = 0.3
# Mean reprojection error in training pixels. In that room cameras off by .17 pixels gained nothing,
# by .5 pixels .27 dB, by 1.7 pixels 2 dB and more. Cameras of SfM lost .65 and .7 dB.
WORTH_PX = 0.5
_PREFIX = "poses"


class Poses:
    """The twists of all training cameras, and their optimizer.

    A twist is a turn about the camera's own centre, as a rotation vector, and a move of that
    centre, both in world axes: C' = exp(w) C for the camera-to-world rotation, c' = c + v. The mean
    twist is held at 0, and moves do not widen or narrow the path. `centers` [F, 3] are those of the
    cameras as found, in world units; `visits` the steps of each image; `error` how far a camera may
    be off, in rad.
    """

    def __init__(
        self, centers: NDArray[np.float64], extent: float, *, visits: float, error: float
    ) -> None:
        self._rows = SparseAdam(torch.zeros(len(centers), 6))
        self._arms = torch.from_numpy(centers - centers.mean(axis=0))
        self._unit = _MOVE * extent
        self._rate = _REACH * error / visits

    @property
    def twists(self) -> NDArray[np.float64]:
        """Turns in rad and moves in world units, [F, 6]; a copy."""
        scales = np.repeat((1.0, self._unit), 3)
        return np.asarray(self._rows.value.numpy() * scales)

    def camera(self, image: int, camera: Camera) -> Camera:
        """Returns an image's camera as it is refined so far."""
        twist = self.twists[image]
        return move_camera(camera, twist[:3], twist[3:]) if twist.any() else camera

    def step(self, image: int, gradient: NDArray[np.float64], done: float) -> None:
        """Moves one camera against `gradient` [6]; the rate falls as `done` goes from 0 to 1."""
        self._rows.step(image, gradient, self._rate * _FINAL**done)
        self._rows.center()
        if self._rows.complete and self._arms.any():
            moves = self._rows.value[:, 3:]
            moves -= (moves * self._arms).sum() / self._arms.square().sum() * self._arms

    def tensors(self) -> dict[str, Tensor]:
        """Returns twists, moments and counts by name, for a checkpoint."""
        return self._rows.tensors(_PREFIX)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restores what `tensors` returned."""
        self._rows.restore(_PREFIX, tensors)


def worth_a_trial(error_px: float | None) -> bool:
    """Returns whether refinement may help; `error_px` is the mean reprojection error, if known."""
    return error_px is not None and error_px > WORTH_PX


def move_camera(
    camera: Camera,
    turn: NDArray[np.float64],  # [3] rotation vector in world axes, rad
    move: NDArray[np.float64],  # [3] world units
) -> Camera:
    """Returns a camera that is turned about its centre and then moved."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ Rotation.from_rotvec(turn).as_matrix().T
    viewmat[:3, 3] = -viewmat[:3, :3] @ (camera.center + move)
    return replace(camera, viewmat=viewmat)


def camera_gradient(
    splats: Splats, gradients: Splats, camera: Camera, sh_degree: int
) -> NDArray[np.float64]:
    """Returns the gradient [6] of a loss for a further turn (rad) and move (world units).

    What the step left for the Gaussians is enough, because a picture stays the same when camera
    and scene move together:

        move   dL/dv = - sum dL/dmean
        turn   dL/dw = - sum [(mean - c) x dL/dmean + torque(quat) + torque(sh)]

    A scene that turns takes its orientations along, q' = (1, w/2) q, so that with q = (s, u) and
    its gradient (a, b) torque(quat) = (s b - a u + u x b) / 2; and its colours: what was seen along
    d is seen along exp(w) d. Turning the harmonics undoes just what the turn of the direction d to
    the mean does to the colour, and dL/dmean holds the latter, so that
    torque(sh) = - d x d/dd sum_k p_k Y_k(d), with p_k = sum over channels of sh_rest_k dL/dcolour,
    and dL/dcolour = dL/dsh_dc / SH_C0.

    Sums over Gaussians are taken in float64 and in a fixed order, whatever the number of threads.

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
