"""Putting a browser's camera where a camera of ours stands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import quaternion
from recon_cli.viewer.content import HELD_OUT, Content, Eye, ShownView, vertical_fov
from recon_cli.viewer.photo_pairs import Pictures

_SIZE = 0.03  # of the distance to what is looked at
_COLORS = {HELD_OUT: (255, 140, 40)}
_OTHERS = (150, 170, 200)


class Frustums:
    """The cameras of all views in one browser.

    Args:
        client: the browser.
        content: whose views they are.
        jump: called with the label of the view whose camera was clicked.
    """

    def __init__(
        self, client: viser.ClientHandle, content: Content, jump: Callable[[str], None]
    ) -> None:
        self._client, self._content, self._jump = client, content, jump
        self._parent = client.scene.add_frame("/cameras", show_axes=False)
        with client.atomic():
            self._handles = {
                shown.label: self._add(number, shown)
                for number, shown in enumerate(content.views)}

    def _add(self, number: int, shown: ShownView) -> viser.CameraFrustumHandle:
        camera = shown.view.camera
        handle = self._client.scene.add_camera_frustum(
            f"/cameras/{number}", vertical_fov(camera), camera.width / camera.height,
            scale=_SIZE * self._content.distance, thickness=1.5, thickness_units="screen",
            color=_COLORS.get(shown.part, _OTHERS),
            wxyz=quaternion(camera.viewmat[:3, :3].T), position=camera.center,
            cast_shadow=False, receive_shadow=False)
        handle.on_click(lambda _: self._jump(shown.label))
        return handle

    def show(self, visible: bool) -> None:
        """Shows or hides all of them."""
        self._parent.visible = visible

    def fill(self, pictures: Pictures, stopped: Callable[[], bool]) -> None:
        """Puts the photos in, until it is told to stop."""
        for shown in self._content.views:
            if stopped():
                return
            self._handles[shown.label].image = pictures.thumbnail(shown.view)


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
