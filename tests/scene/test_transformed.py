"""Gaussians and cameras moved together give the image that was there before."""

import math

import numpy as np
import pytest
import torch
from scenes import camera_at, random_splats, with_harmonics
from test_similarity import random_rotation

from recon_cli.render import render
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import quaternion, transformed

# Float64 through projection, covariance and compositing; measured 2e-13 in the worst of the cases.
PIXEL = 1e-10
WHITE = torch.ones(3, dtype=torch.float64)


def seen(splats, camera, degree=3):
    with torch.no_grad():
        return render(splats, camera, WHITE, degree, backend="torch")


@pytest.mark.parametrize("scale", [1.0, 0.37, 4.2])
@pytest.mark.parametrize("seed", range(3))
def test_a_moved_camera_sees_the_same_image_of_moved_gaussians(seed, scale):
    rng = np.random.default_rng(seed)
    similarity = Similarity(scale, random_rotation(rng), rng.normal(size=3))
    # NEAR is a length in world units and does not move along: keep clear of it.
    splats = random_splats(80, seed=seed)
    splats.means[:, 2] += 2
    splats.sh_rest[:] *= 5  # colours that depend strongly on the direction
    before = seen(splats, camera_at())
    after = seen(transformed(splats, similarity), similarity.camera(camera_at()))
    assert torch.allclose(before.rgb, after.rgb, rtol=0, atol=PIXEL)
    assert torch.allclose(before.alpha, after.alpha, rtol=0, atol=PIXEL)
    assert torch.allclose(scale * before.depth, after.depth, rtol=0, atol=PIXEL)


@pytest.mark.parametrize(("degree", "colored"), [(0, 80), (1, 30), (2, 80), (3, 0), (3, 31)])
def test_splats_of_any_degree_and_share_move_alike(degree, colored):
    rng = np.random.default_rng(7)
    similarity = Similarity(1.5, random_rotation(rng), rng.normal(size=3))
    splats = with_harmonics(random_splats(80, seed=7), degree, colored)
    splats.means[:, 2] += 2
    splats.sh_rest[:] *= 5
    moved = transformed(splats, similarity)
    assert moved.sh_rest.shape == splats.sh_rest.shape
    before, after = seen(splats, camera_at()), seen(moved, similarity.camera(camera_at()))
    assert torch.allclose(before.rgb, after.rgb, rtol=0, atol=PIXEL)


def test_without_turning_the_colours_the_image_would_change():
    rng = np.random.default_rng(0)
    similarity = Similarity(rotation=random_rotation(rng))
    splats = random_splats(80, seed=0)
    splats.sh_rest[:] *= 5
    moved = transformed(splats, similarity)
    moved.sh_rest = splats.sh_rest
    before, after = seen(splats, camera_at()), seen(moved, similarity.camera(camera_at()))
    assert (before.rgb - after.rgb).abs().max() > 0.05


def test_there_and_back_is_where_it_began():
    rng = np.random.default_rng(5)
    similarity = Similarity(2.5, random_rotation(rng), rng.normal(size=3))
    splats = random_splats(50)
    back = transformed(transformed(splats, similarity), similarity.inverse())
    for name, value in splats.parameters().items():
        close = torch.allclose(getattr(back, name), value, rtol=0, atol=1e-12)
        assert close or (name == "quats" and torch.allclose(-back.quats, value, atol=1e-12))


def test_a_change_of_scale_touches_means_and_scales_alone():
    splats = random_splats(20, dtype=torch.float32)
    moved = transformed(splats, Similarity(scale=2.0))
    assert torch.equal(moved.means, 2 * splats.means)
    assert torch.allclose(moved.log_scales, splats.log_scales + math.log(2), atol=1e-6)
    for name in ("quats", "sh_dc", "sh_rest", "logit_opacities"):
        assert torch.equal(getattr(moved, name), getattr(splats, name))
    assert moved.means.dtype == torch.float32


def test_a_quaternion_of_zeros_stands_for_no_rotation_and_so_turns_with_the_world():
    splats = random_splats(3)
    splats.quats[0] = 0
    splats.quats[1] *= 1e-3
    rotation = random_rotation(np.random.default_rng(2))
    moved = transformed(splats, Similarity(rotation=rotation))
    assert torch.allclose(moved.quats[0], torch.from_numpy(quaternion(rotation)), atol=1e-12)
    assert torch.allclose(moved.quats.norm(dim=1)[1:], splats.quats.norm(dim=1)[1:], atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_the_quaternion_of_a_half_turn_is_its_axis(axis):
    half = -np.eye(3)
    half[axis, axis] = 1
    found = np.abs(quaternion(half))
    assert np.allclose(found, np.eye(4)[axis + 1], atol=1e-12)
