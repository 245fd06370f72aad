"""`recon render --panorama`: equirectangular frames, put together from the faces of a cube.

They are level: whoever looks around in them turns the head, not the picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.io.panoramas import stitch_faces
from recon_cli.render import RenderOutput, render
from recon_cli.scene.camera import Camera
from recon_cli.scene.faces import CUBE, face_camera, face_size, pixel_rays
from recon_cli.scene.splats import Splats

WIDTH = 2048  # pixels, of a frame where no size is asked for


def panorama_camera(
    viewmat: NDArray[np.float64], up: NDArray[np.float64], width: int
) -> Camera:
    """Returns the place and axes of a level panorama, whose middle looks as a camera does.

    `viewmat` is [4, 4] world to camera, `up` a unit vector [3]. The focal length is that of the
    middle of the picture; nothing is projected by it.
    """
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    forward = viewmat[2, :3] - (viewmat[2, :3] @ up) * up
    if np.linalg.norm(forward) < 1e-3:  # straight up or down: where its upper edge points
        forward = -viewmat[1, :3] + (viewmat[1, :3] @ up) * up
    forward /= np.linalg.norm(forward)
    level = np.eye(4)
    level[:3, :3] = np.stack([np.cross(forward, up), -up, forward])
    level[:3, 3] = -level[:3, :3] @ center
    height, focal = width // 2, width / (2 * np.pi)
    return Camera(width, height, focal, focal, width / 2, height / 2, level)


def face_cameras(panorama: Camera) -> list[Camera]:
    """Returns the cameras of the faces of a panorama."""
    side, focal = face_size(panorama.width / (2 * np.pi))
    return [face_camera(face, side, focal, panorama.viewmat) for face in CUBE]


def render_panorama(
    splats: Splats, panorama: Camera, background: Tensor, sh_degree: int, *, backend: str
) -> RenderOutput:
    """Returns the images of a panorama; depth is the distance from the camera.

    The statistics are those of the last face.
    """
    cameras = face_cameras(panorama)
    faces = [render(splats, camera, background, sh_degree, backend=backend)
             for camera in cameras]
    lengths = [np.linalg.norm(pixel_rays(camera), axis=2) for camera in cameras]
    layers = [np.dstack([
        face.rgb.cpu().numpy(), face.alpha.cpu().numpy(), face.depth.cpu().numpy() * length])
        for face, length in zip(faces, lengths, strict=True)]
    joined = torch.from_numpy(_stitch(layers, cameras, panorama))
    return replace(faces[-1], rgb=joined[..., :3].contiguous(), alpha=joined[..., 3].contiguous(),
                   depth=joined[..., 4].contiguous())


def join_faces(
    panorama: Camera, measure: Callable[[Camera], NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Returns what is measured [H, W] on each face, as a panorama [H, W]."""
    cameras = face_cameras(panorama)
    return _stitch([measure(camera)[..., None] for camera in cameras], cameras, panorama)[..., 0]


def _stitch(
    layers: list[NDArray[np.float32]], cameras: list[Camera], panorama: Camera
) -> NDArray[np.float32]:
    return stitch_faces([layer.astype(np.float32) for layer in layers], cameras,
                        panorama.viewmat[:3, :3], panorama.width, panorama.height)
