"""Browsers receive the Gaussians within the precision of the sent numbers."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes import random_splats

from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.viewer.gaussians import pack_splats


def one(scales, quat=(1.0, 0, 0, 0), mean=(1.0, -2.0, 3.0)):
    return Splats(
        torch.tensor([mean]), torch.tensor([quat]), torch.log(torch.tensor([scales])),
        torch.tensor([0.0]), torch.zeros(1, 3), torch.zeros(0, 0, 3))


def test_a_turned_gaussian_has_the_covariance_r_s_s_r():
    half = float(np.sqrt(0.5))
    quat = (2 * half, 0, 0, 2 * half)  # a quarter turn about z
    found = pack_splats(one((0.3, 0.2, 0.1), quat=quat))
    covariance = found.covariances[0].astype(float) * found.scale**2
    np.testing.assert_allclose(
        covariance, np.diag([0.04, 0.09, 0.01]), atol=0.09 * 2**-10)
    np.testing.assert_allclose(found.centers[0] * found.scale, [1, -2, 3], rtol=1e-6)
    assert found.opacities.tolist() == [[128]]
    assert found.colors(None).tolist() == [[128, 128, 128]]


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_covariances_fit_half_precision_whatever_the_unit_of_the_scene(unit):
    generator = torch.Generator().manual_seed(3)
    splats = random_splats(200, seed=3, dtype=torch.float32)
    scales = 10 ** (4 * torch.rand(200, 1, generator=generator) - 3.5).repeat(1, 3)
    splats = dataclasses.replace(
        splats, means=splats.means * unit, log_scales=torch.log(scales * unit))
    found = pack_splats(splats)
    sizes = np.sqrt(np.linalg.eigvalsh(found.covariances.astype(float))) * found.scale
    np.testing.assert_allclose(sizes, (scales * unit).numpy(), rtol=2e-3)


def test_one_gaussian_as_large_as_the_world_leaves_the_others_their_size():
    splats = random_splats(50, seed=1, dtype=torch.float32)
    splats.log_scales[:] = -4.0
    splats.log_scales[7] = 20.0
    found = pack_splats(splats)
    sizes = np.sqrt(np.linalg.eigvalsh(found.covariances.astype(float))) * found.scale
    np.testing.assert_allclose(np.delete(sizes, 7, axis=0), np.exp(-4.0), rtol=2e-3)
    assert np.isfinite(sizes[7]).all()


def test_what_is_not_finite_is_left_out_and_nothing_is_no_error():
    splats = random_splats(5, seed=2, dtype=torch.float32)
    splats.means[1, 0] = float("nan")
    splats.log_scales[3, 2] = float("inf")
    assert len(pack_splats(splats).splats) == 3
    empty = pack_splats(splats.select(torch.zeros(5, dtype=torch.bool)))
    assert empty.centers.shape == (0, 3)
    assert empty.colors((0.0, 0.0, 0.0)).shape == (0, 3)


def test_colours_are_those_that_a_camera_at_that_place_sees():
    splats = one((0.5, 0.5, 0.5), mean=(0.0, 0.0, 2.0))
    rest = torch.tensor([[[0.3, -0.2, 0.1], [0.5, 0.4, -0.6], [0.2, -0.3, 0.1]]])
    splats = dataclasses.replace(
        splats, sh_rest=rest, logit_opacities=torch.tensor([20.0]))
    along_z, along_minus_x = np.eye(3), np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    for place, turn in (((0.0, 0.0, 0.0), along_z), ((3.0, 0.0, 2.0), along_minus_x)):
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ np.array(place)
        camera = Camera(33, 33, 30.0, 30.0, 16.5, 16.5, viewmat)
        output = render(splats, camera, torch.zeros(3), 1)
        seen = (output.rgb / output.alpha[..., None])[16, 16].clamp(0, 1).numpy() * 255
        assert np.abs(pack_splats(splats).colors(place)[0] - seen).max() <= 0.51
