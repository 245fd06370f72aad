"""Cameras for a scene without any, and what a file of it is said to lose there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from facts import raises

from recon_cli.context import StageContext
from recon_cli.errors import ReconstructionError
from recon_cli.export.synthetic_cameras import ASSUMED_DB, SelfPsnr, synthetic_scene
from recon_cli.scene.splats import SH_C0, Splats

CONTEXT = StageContext(backend="numba")
Z_UP = np.array([0.0, 0, 1])


def gaussians(places, *, scale=0.1, opacity=0.95, gray=0.5):
    n = len(places)
    return Splats(
        torch.tensor(np.asarray(places), dtype=torch.float32),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), torch.full((n, 3), scale).log(),
        torch.logit(torch.full((n,), opacity)), torch.full((n, 3), (gray - 0.5) / SH_C0),
        torch.zeros(0, 0, 3))


def shell(radius=2.0, n=1500):
    """Places on a sphere, each with the one opposite."""
    ways = np.random.default_rng(0).standard_normal((n // 2, 3))
    ways = np.concatenate([ways, -ways])
    return radius * ways / np.linalg.norm(ways, axis=1, keepdims=True)


@pytest.mark.parametrize("scale", [1e-4, 0.1, 20.0])
def test_one_gaussian_of_any_size_is_seen(scale):
    one = gaussians([[3.0, 0, 0]], scale=scale)
    SelfPsnr.from_renders(one, cameras_of(synthetic_scene(one, up=Z_UP, max_size=48)), CONTEXT)


def cameras_of(scene):
    return [view.camera for view in scene.train]


def center(view):
    return view.camera.center


@pytest.mark.parametrize("up", [Z_UP, np.array([0.0, -1, 0]), np.array([0.0, 1, 0])])
def test_four_cameras_look_at_the_middle_from_outside_and_four_outward_from_within(up):
    scene = synthetic_scene(gaussians(shell() + np.array([5.0, 0, 0])), up=up, max_size=90)
    around, inside = scene.train[:4], scene.train[4:]
    for view in around:
        place = view.camera.viewmat @ [5, 0, 0, 1]
        assert np.allclose(place[:2], 0, atol=0.1)  # the middle of the picture
        assert place[2] == pytest.approx(2 * np.hypot(2.5, 0.6), rel=0.05)
    for view in inside:
        assert np.linalg.norm(center(view) - [5, 0, 0]) < 0.6 * 2.01
        assert abs(view.camera.viewmat[2, :3] @ up) < 1e-9  # level
    for view in scene.train:
        assert view.camera.viewmat[1, :3] @ up < 0  # y of a camera is down
        assert (view.camera.width, view.camera.height) == (90, 60)


def test_the_camera_within_stands_where_there_is_most_space():
    """A ball that is full on one side."""
    draw = np.random.default_rng(1).uniform(-2, 2, (4000, 3))
    full = draw[(np.linalg.norm(draw, axis=1) < 2) & (draw[:, 0] > -0.2)]
    scene = synthetic_scene(gaussians(np.concatenate([full, shell()])), up=Z_UP, max_size=60)
    assert center(scene.train[4])[0] < -0.2


def test_far_and_faint_gaussians_move_no_camera():
    near = shell()
    far = gaussians([*near, *(100 * shell(n=100))])
    faint = gaussians([*near, *([[3.0, 3, 3]] * 5000)])
    faint.logit_opacities[len(near):] = -5
    plain = synthetic_scene(gaussians(near), up=Z_UP, max_size=60)
    assert np.allclose(center(synthetic_scene(faint, up=Z_UP, max_size=60).train[0]),
                       center(plain.train[0]))
    assert np.allclose(center(synthetic_scene(far, up=Z_UP, max_size=60).train[0]),
                       center(plain.train[0]), atol=0.5)


def test_the_loss_is_that_of_a_scene_which_is_30_db_from_its_photos():
    whole = gaussians(shell(), scale=0.3)
    scene = synthetic_scene(whole, up=Z_UP, max_size=60)
    found = SelfPsnr.from_renders(whole, cameras_of(scene), CONTEXT)
    assert found.psnr_db(whole) == pytest.approx(ASSUMED_DB)
    darker = gaussians(shell(), scale=0.3, gray=0.4)
    expected = []
    for camera, before, seen in found.views:
        change = SelfPsnr.from_renders(darker, cameras_of(scene), CONTEXT).views
        after = next(image for other, image, _ in change if other is camera)
        expected.append(-10 * np.log10(1e-3 + ((after - before)[seen] ** 2).mean()))
    assert found.psnr_db(darker) == pytest.approx(np.mean(expected), abs=1e-4)
    assert found.psnr_db(darker) < 21  # .1 of the range is 20 dB where it covers all


def test_a_scene_that_nobody_sees_is_refused():
    clear = gaussians(shell(), opacity=0.002)
    scene = synthetic_scene(clear, up=Z_UP, max_size=60)
    with raises(ReconstructionError, "sees", "anything"):
        SelfPsnr.from_renders(clear, cameras_of(scene), CONTEXT)
