"""A mottled wall filmed at changing speed, with the shutter open for a known time."""

import dataclasses

import numpy as np
import torch
from wall_scene import splats_at

from recon_cli.render import render
from recon_cli.scene.motion import Moment, camera_motions
from recon_cli.scene.train_view import TrainView
from recon_cli.train.motion_blur import mean_light
from recon_cli.train.shutter import ViewMotions

STEP = 0.1  # seconds from view to view


def wall():
    """Patches of two greys, finer than those of wall_scene: edges that blur can take."""
    x, y = np.meshgrid(np.linspace(-3, 3, 101), np.linspace(-1.8, 1.8, 61))
    points = np.stack([x, y, np.full_like(x, 2.0)], -1).reshape(-1, 3)
    rough = np.random.default_rng(5).random((16, 26))[
        (np.arange(61) // 4)[:, None], (np.arange(101) // 4)[None]]
    return points, np.repeat(np.where(rough > 0.5, 0.75, 0.2).reshape(-1, 1), 3, axis=1)


def filmed(task, shutter, *, along=9):
    """The task of the same cameras as views of this wall, sharp where `shutter` is 0, with motions.

    The second is the list of sharp views.
    """
    points, colors = wall()
    truth = splats_at(points, colors, 0.03)
    count = len(task.train)
    # fast in the middle of the path, slow at its ends
    way = np.cumsum(1.2 - np.cos(np.linspace(0, 4 * np.pi, count)))
    way = (way - way.mean()) / np.ptp(way) * 1.6
    cameras = {}
    for row, (view, x) in enumerate(zip(task.train, way, strict=True)):
        viewmat = np.eye(4)
        viewmat[0, 3] = -x
        cameras[f"{row:03d}"] = dataclasses.replace(view.camera, viewmat=viewmat)
    motions = camera_motions(
        cameras, {name: Moment("v", STEP * row) for row, name in enumerate(cameras)})

    def photograph(camera, motion, seconds):
        shares = (np.arange(along) + 0.5) / along - 0.5 if seconds else [0.0]
        with torch.no_grad():
            image = mean_light([
                render(truth, motion.at(camera, seconds * share), torch.zeros(3), 0,
                       backend="numba").rgb for share in shares])
        return TrainView(camera, (255 * image.clamp(0, 1)).round().byte().numpy())

    views = [[photograph(camera, motions[name], seconds) for name, camera in cameras.items()]
             for seconds in (shutter, 0.0)]
    moved = ViewMotions(tuple(motions.values()), (), points)
    return dataclasses.replace(task, train=views[0], motions=moved), views[1]
