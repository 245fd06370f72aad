"""Cameras that were disturbed come back while a small synthetic scene is trained."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import random_splats
from scipy.spatial.transform import Rotation

from recon_cli.config.stages import TrainConfig
from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.train.gradient import gradient_step
from recon_cli.train.poses import Poses, move_camera
from recon_cli.train.state import new_state

pytestmark = pytest.mark.integration

VIEWS, WIDTH, HEIGHT, FOCAL = 8, 80, 60, 70.0
TURN, MOVE = np.radians(1.0), 0.01  # of the disturbance, in rad and world units
EXTENT = 1.0


def scene():
    """Gaussians in a block of 3 x 2.4 units before the cameras, all opaque enough to be seen."""
    splats = random_splats(300, seed=3, dtype=torch.float32)
    splats.means[:, 2] = 2 + splats.means[:, 2].abs() / 2
    splats.log_scales = splats.log_scales.clamp(-3.5, -2.0)
    splats.logit_opacities = splats.logit_opacities.clamp_min(1.0)
    return splats


def cameras():
    """Eight of them on an arc of one unit, looking at the middle of the block."""
    result = []
    for angle in np.linspace(-0.3, 0.3, VIEWS):
        turn = Rotation.from_rotvec([0.3 * np.cos(9 * angle) * 0.3, -angle, 0.0]).as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn.T
        viewmat[:3, 3] = -turn.T @ [3 * np.sin(angle), 0.0, 3 - 3 * np.cos(angle)]
        result.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, viewmat))
    return result


def photographs(splats):
    views = []
    for camera in cameras():
        with torch.no_grad():
            rgb = render(splats, camera, torch.zeros(3), 3, backend="numba").rgb
        views.append(TrainView(camera, (rgb.clamp(0, 1) * 255).round().byte().numpy()))
    return views


def disturbed(views):
    """The views with cameras off by a degree and a centimetre.

    The mean of all that is zero and the path keeps its size: what the scene could follow, and
    refinement therefore never takes back, is left out.
    """
    rng = np.random.default_rng(0)
    turns, moves = rng.normal(size=(2, VIEWS, 3))
    arms = np.stack([view.camera.center for view in views])
    arms -= arms.mean(axis=0)
    turns, moves = turns - turns.mean(axis=0), moves - moves.mean(axis=0)
    moves -= (moves * arms).sum() / (arms * arms).sum() * arms
    turns *= TURN / np.linalg.norm(turns, axis=1).mean()
    moves *= MOVE / np.linalg.norm(moves, axis=1).mean()
    return [replace(view, camera=move_camera(view.camera, turn, move))
            for view, turn, move in zip(views, turns, moves, strict=True)]


def poses_for(views, visits):
    centers = np.stack([view.camera.center for view in views])
    return Poses(centers, EXTENT, visits=visits, error=TURN)


def train(splats, views, epochs, *, poses, scene_moves):
    config = TrainConfig(iterations=epochs * VIEWS, max_gaussians=300)
    state = new_state(splats, config, EXTENT, backend="numba")
    compute, generator = gradient_step("numba"), torch.Generator().manual_seed(0)
    for step in range(epochs * VIEWS):
        if step % VIEWS == 0:
            order = torch.randperm(VIEWS, generator=generator).tolist()
        image = order[step % VIEWS]
        view = views[image]
        if poses is not None:
            view = replace(view, camera=poses.camera(image, view.camera))
        compute(state.optimizer, view, StepOptions(3, 0.2))
        if poses is not None:
            poses.step(image, compute.camera_gradient(state.optimizer, view.camera, 3),
                       step / (epochs * VIEWS))
        if scene_moves:
            state.optimizer.step(1.6e-4)
    return state.splats


def errors(found, truth):
    """Median turn in rad and move that is left, with what all cameras have in common taken off."""
    turns = Rotation.from_matrix(np.stack([
        a.viewmat[:3, :3].T @ b.viewmat[:3, :3] for a, b in zip(found, truth, strict=True)]))
    moves = np.stack([a.center - b.center for a, b in zip(found, truth, strict=True)])
    turns = (turns.mean().inv() * turns).magnitude()
    return np.median(turns), np.median(np.linalg.norm(moves - moves.mean(axis=0), axis=1))


def test_cameras_before_a_known_scene_come_back():
    truth = photographs(scene())
    views = disturbed(truth)
    poses = poses_for(views, visits=14)  # at the rate of a short run
    train(scene(), views, 120, poses=poses, scene_moves=False)
    found = [poses.camera(i, view.camera) for i, view in enumerate(views)]
    turn, move = errors(found, [view.camera for view in truth])
    assert turn < 0.1 * TURN
    assert move < 0.2 * MOVE


def test_cameras_come_back_while_the_scene_is_learnt():
    truth = photographs(scene())
    start = scene()
    start.sh_dc, start.sh_rest = torch.zeros(300, 3), torch.zeros(300, 15, 3)
    start.means += 0.01 * torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    views = disturbed(truth)
    poses = poses_for(views, visits=100)
    before = errors([view.camera for view in views], [view.camera for view in truth])
    refined = train(start, views, 100, poses=poses, scene_moves=True)
    found = [poses.camera(i, view.camera) for i, view in enumerate(views)]
    after = errors(found, [view.camera for view in truth])
    assert after[0] < 0.5 * before[0]
    left = train(start, views, 100, poses=None, scene_moves=True)
    assert seen_db(refined, found, truth) > seen_db(left, [v.camera for v in views], truth) + 2


def seen_db(splats, found, truth):
    """Mean PSNR of the training views through cameras."""
    values = []
    for camera, view in zip(found, truth, strict=True):
        with torch.no_grad():
            rgb = render(splats, camera, splats.background, 3, backend="numba").rgb.numpy()
        values.append(-10 * np.log10(np.mean((rgb.clip(0, 1) - view.image / 255) ** 2)))
    return np.mean(values)
