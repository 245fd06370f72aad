"""A wall whose depth is known exactly, and views of it, for tests of dense stereo."""

from __future__ import annotations

import numpy as np

from recon_cli.room.volume import pixel_rays
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView

UP = np.array([0.0, 0.0, 1.0])
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
WIDTH, HEIGHT = 160, 120


def camera(eye, target=(3.0, 0.0, 0.0), width=WIDTH, height=HEIGHT):
    viewmat = looking_at(np.array(eye, float), np.array(target, float), UP)
    return Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, viewmat)


def wall(view: Camera, slant: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the wall x = 3 + slant y, and the places where pixels meet it, [H, W, 3]."""
    rays = pixel_rays(view) @ view.viewmat[:3, :3]
    normal = np.array([1.0, -slant, 0.0])
    depth = (3.0 - view.center @ normal) / (rays @ normal)
    return depth.astype(np.float32), view.center + rays * depth[..., None]


def grain(places: np.ndarray) -> np.ndarray:
    """A texture of many waves, 40 to 200 grey levels."""
    generator = np.random.default_rng(5)
    waves = generator.normal(size=(40, 3)) * generator.uniform(2, 25, (40, 1))
    phases = generator.uniform(0, 6.3, 40)
    return np.clip(120 + 12 * np.cos(places @ waves.T + phases).sum(-1), 40, 200)


def shading(places: np.ndarray) -> np.ndarray:
    """A painted wall: a lamp's light and the shadow at an edge, half a grey level a pixel."""
    return 150 - 9 * ((places[..., 1] - 0.2) ** 2 + (places[..., 2] - 0.1) ** 2) + (
        12 / (1 + np.exp(-6 * (places[..., 1] + places[..., 2]))))


def views_of(cameras, paint, slant=0.0):
    """Views of the wall, painted."""
    views = []
    for view in cameras:
        grey = np.rint(paint(wall(view, slant)[1])).astype(np.uint8)
        views.append(TrainView(view, np.repeat(grey[..., None], 3, axis=2)))
    return views


AROUND = [camera((0.0, y, z)) for y in (-0.5, -0.25, 0.0, 0.25, 0.5) for z in (-0.2, 0.2)]


def errors(cameras, found, slant=0.0):
    """Relative errors where there is depth, and the share of pixels that have one."""
    depth = np.stack(found)
    truth = np.stack([wall(view, slant)[0] for view in cameras])
    there = depth > 0
    return np.abs(depth[there] / truth[there] - 1), there.mean()
