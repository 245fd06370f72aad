"""Putting a browser's camera where a camera of ours stands."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.viewer.content import Eye

_STEEP = 0.05  # cosine between the image's up and the world's, below which a view looks up or down


def stand(
    client: viser.ClientHandle, eye: Eye, up: NDArray[np.float64] | None, camera: Camera
) -> None:
    """Moves a browser to where a camera stands, with its roll and field of view.

    The browser's own up becomes that of the world as the camera sees it, so that a drag of the
    mouse afterwards still turns around the vertical.
    """
    right, image_up = camera.viewmat[0, :3], -camera.viewmat[1, :3]
    world_up = image_up if up is None else up - (up @ right) * right
    with client.atomic():
        client.camera.up_direction = world_up if world_up @ image_up > _STEEP else image_up
        client.camera.position = eye.position
        client.camera.look_at = eye.look_at
        client.camera.fov = eye.fov
