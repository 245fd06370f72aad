"""Training views that need not be rendered: what they show follows from their neighbours.

Successive frames of a walk show nearly the same. So some views, evenly spread over places and
directions, are rendered, and tell which Gaussians the others show.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.contract import NEAR
from recon_cli.render.view_gradient import TensorCamera
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.trust.support import ViewSupport

# One of so many views is rendered, but not fewer than `_LEAST`. Of what the others show on a walk
# 97% is found, and 97% of what is found they show; shares of the surface change by .005.
_EVERY = 3
_LEAST = 15
_NEIGHBORS = 2  # rendered views that tell what a view shows

Array = NDArray[np.float64]


def rendered_count(views: int) -> int:
    """Returns how many of so many views are rendered."""
    return -(-views // min(_EVERY, max(1, views // _LEAST)))


def pose_distances(cameras: Sequence[Camera], splats: Splats) -> Array:
    """Returns how far V poses lie apart, [V, V]: the angle in rad, plus the way in room sizes."""
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.viewmat[2, :3] for camera in cameras])
    middle = torch.as_tensor(centers.mean(0), dtype=splats.means.dtype, device=splats.means.device)
    room = float((splats.means - middle).norm(dim=1).nanmedian())
    way = np.linalg.norm(centers[:, None] - centers[None], axis=2) / max(room, 1e-9)
    return np.asarray(way + np.arccos((axes @ axes.T).clip(-1, 1)))


def spread_views(apart: Array, count: int) -> list[int]:
    """Returns `count` of V views, ascending: the first, and each time the farthest from all so far.

    Every third by name would be one camera of a rig of three, or one face of each panorama.
    """
    chosen = [0]
    nearest = apart[0].copy()
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, apart[chosen[-1]])
    return sorted(chosen)


def support_of_all(
    support: ViewSupport, splats: Splats, cameras: Sequence[Camera], apart: Array,
    rendered: Sequence[int],
) -> ViewSupport:
    """Returns the support in all `cameras`; `support` is that in those at `rendered`.

    Another camera shows what one of the two nearest rendered ones shows, as far as it lies in its
    frame, or beside it by no more than a standard deviation.
    """
    centers = np.stack([camera.center for camera in cameras])
    own = dict(zip(rendered, support.rows, strict=True))
    order = np.argsort(apart[:, list(rendered)], axis=1, kind="stable")[:, :_NEIGHBORS]
    radii = splats.log_scales.amax(1).exp()
    every: list[Tensor] = []
    for index, camera in enumerate(cameras):
        if index in own:
            every.append(own[index])
            continue
        shown = torch.zeros(len(splats), dtype=torch.bool, device=splats.means.device)
        for neighbor in order[index]:
            shown[support.rows[neighbor]] = True
        rows = torch.nonzero(shown)[:, 0]
        every.append(rows[_in_frame(splats.means[rows], radii[rows], camera)])
    return ViewSupport.from_rows(every, centers, support.residual, support.digest)


def _in_frame(means: Tensor, radii: Tensor, camera: Camera) -> Tensor:
    """Returns which of K balls the frame of a camera touches, [K] bool."""
    pixels, z = TensorCamera.from_camera(camera, means).project(means)
    u, v = pixels.unbind(1)
    wide, high = camera.fx * radii / z, camera.fy * radii / z
    return ((z > NEAR) & (u >= -wide) & (u < camera.width + wide)
            & (v >= -high) & (v < camera.height + high))
