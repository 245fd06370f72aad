"""gsplat's CUDA kernels as a candidate, where that package is installed; nothing here needs it."""

from __future__ import annotations

import importlib
import importlib.util

import torch
from torch import Tensor

from recon_cli.experiments.synthetic_room import RoomScene
from recon_cli.render.contract import NEAR
from recon_cli.scene.splats import Splats


def installed() -> bool:
    """Tells whether there is a gsplat to import."""
    return importlib.util.find_spec("gsplat") is not None


class Gsplat:
    """The same scene in the form that gsplat.rasterization takes.

    Opacities and scales are activated ahead, so that its time is that of its kernels alone; its
    low-pass filter, smallest alpha and transmittance are those of the contract by default, its
    greatest alpha is higher.

    Args:
        scene: on a GPU.

    Attributes:
        leaves: means, quats, scales, opacities, harmonics.
    """

    def __init__(self, scene: RoomScene) -> None:
        splats: Splats = scene.splats.map(lambda tensor: tensor.detach())
        harmonics = torch.cat([splats.sh_dc[:, None], splats.sh_rest], 1)
        self.leaves = [tensor.clone().requires_grad_() for tensor in (
            splats.means, splats.quats, splats.scales, splats.opacities, harmonics)]
        camera, like = scene.camera, splats.means
        self._viewmats = like.new_tensor(camera.viewmat)[None]
        self._intrinsics = like.new_tensor([
            [camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])[None]
        self._scene = scene
        self._rasterization = importlib.import_module("gsplat").rasterization

    def picture(self) -> Tensor:
        """Returns the picture [H, W, 3] before black."""
        camera = self._scene.camera
        colors, _, _ = self._rasterization(
            *self.leaves, self._viewmats, self._intrinsics, camera.width, camera.height,
            near_plane=NEAR, sh_degree=self._scene.sh_degree, packed=False)
        return colors[0]
