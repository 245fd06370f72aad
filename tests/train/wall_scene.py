"""A mottled wall, with a window or without, filmed along a short path."""

import numpy as np
import torch

from recon_cli.config.stages import RunConfig
from recon_cli.render import render
from recon_cli.render.response import transmission
from recon_cli.scene.backdrop import fibonacci_sphere
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.task import Task
from recon_cli.train.parts.part import TrialScene

CONFIG = RunConfig(iterations=500, max_gaussians=2000, sh_degree=0, images="original")
EXTENT = 0.5
VIEWS = 26
GREY = (128, 128, 128)


def splats_at(means, colors, scale):
    n = len(means)
    return Splats(
        means=torch.tensor(means, dtype=torch.float32), quats=torch.tensor([[1.0, 0, 0, 0]] * n),
        log_scales=torch.full((n, 3), float(np.log(scale))), logit_opacities=torch.full((n,), 4.0),
        sh_dc=torch.tensor((np.asarray(colors) - 0.5) / 0.28209479, dtype=torch.float32),
        sh_rest=torch.zeros(n, 0, 3))


def wall(window):
    """A mottled wall at z = 2; with a window its right third is missing."""
    x, y = np.meshgrid(np.linspace(-2.5, 2.5, 51), np.linspace(-1.8, 1.8, 37))
    points = np.stack([x, y, np.full_like(x, 2.0)], -1).reshape(-1, 3)
    points = points[points[:, 0] < 0.4] if window else points
    colors = 0.5 + 0.3 * np.sin(points[:, :2] @ np.array([[7.0, 3, 5], [2, 8, 4]]))
    return points, colors


def outside():
    """Stripes of sky so far away that they have no parallax."""
    directions = fibonacci_sphere(4000)
    ahead = directions[directions[:, 2] > 0.6]
    colors = 0.5 + 0.45 * np.sin(ahead[:, :1] * 14 + ahead[:, 1:2] * 9 + np.array([[0.0, 1, 2]]))
    return 60 * ahead, colors


def scene(*, window=False, drift=0.0, config=CONFIG, views=VIEWS, vignette=None):
    points, colors = wall(window)
    far_points, far_colors = outside()
    near, far = splats_at(points, colors, 0.06), splats_at(far_points, far_colors, 1.6)
    truth = Splats(**{name: torch.cat([value, far.parameters()[name]])
                      for name, value in near.parameters().items()}) if window else near
    rng = np.random.default_rng(3)
    shots = []
    for at in np.linspace(-0.5, 0.5, views):
        viewmat = np.eye(4)
        viewmat[:3, 3] = -at, -0.15 * np.sin(9 * at), 0
        camera = Camera(128, 96, 90.0, 90.0, 64.0, 48.0, viewmat)
        with torch.no_grad():
            rgb = render(truth, camera, torch.zeros(3), 0, backend="numba").rgb.numpy()
        if vignette is not None:
            rgb = rgb * transmission(camera, vignette)[..., None]
        gain = np.exp(drift * rng.normal(size=3))
        shots.append(TrainView(camera, (np.clip(rgb * gain, 0, 1) * 255).round().astype(np.uint8)))
    task = Task(shots, [], Schedule(config), EXTENT, "numba", torch.device("cpu"))
    return TrialScene(task, points, (255 * colors).clip(0, 255).astype(np.uint8), None)
