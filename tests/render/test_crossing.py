"""Which Gaussian brings the transmittance down to a level, and the depth of the surface there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from facts import raises
from oracle import composited
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.errors import BackendError
from recon_cli.render.registry import find_crossing
from recon_cli.render.surface_depth import render_surface, surface_of
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

BACKENDS = pytest.mark.parametrize(
    ("backend", "dtype"), [("torch", torch.float64), ("torch", torch.float32),
                           ("numba", torch.float32)])
# A transmittance so near to the level may cross it one Gaussian earlier or later in float32.
MARGIN = 1e-4


@BACKENDS
@pytest.mark.parametrize("level", [0.25, 0.5, 0.75])
def test_the_gaussian_of_a_level_is_that_of_the_brute_force(backend, dtype, level):
    camera, splats = camera_at(), random_splats(200)
    found = find_crossing(splats.map(lambda value: value.to(dtype)), camera, level, backend=backend)
    truth = composited(splats.map(lambda value: value.to(dtype).double()), camera,
                       torch.zeros(3, dtype=torch.float64), 0)
    R, t = torch.from_numpy(camera.viewmat[:3, :3]), torch.from_numpy(camera.viewmat[:3, 3])
    order = torch.argsort((splats.means @ R.T + t)[:, 2], stable=True)
    left = torch.cumprod(1 - truth.alphas[order], 0)
    crossed = left <= level
    expected = torch.where(crossed.any(0), order[crossed.to(torch.uint8).argmax(0)], -1)
    sure = ((left - level).abs().amin(0) > MARGIN) & (truth.margin > MARGIN)
    assert sure.float().mean() > 0.8
    assert (expected[sure] >= 0).any()
    assert (expected[sure] < 0).any()
    assert torch.equal(found[sure], expected[sure])


@BACKENDS
def test_what_is_half_covered_has_no_median(backend, dtype):
    camera = camera_at(16, 16)
    front = one_splat((0.0, 0.0, 2.0), scale=5.0, opacity=0.4, color=(1, 0, 0), dtype=dtype)
    back = one_splat((0.0, 0.0, 4.0), scale=9.0, opacity=0.4, color=(0, 1, 0), dtype=dtype)
    assert (find_crossing(front, camera, backend=backend) == -1).all()
    assert (find_crossing(joined(back, front), camera, backend=backend) == 0).all()
    with raises(ValueError, "level"):
        find_crossing(front, camera, 1.0, backend=backend)


def test_a_backend_that_is_none_is_refused():
    splats = one_splat((0.0, 0.0, 2.0), scale=5.0, opacity=0.4, color=(1, 0, 0))
    with raises(BackendError, "backend"):
        find_crossing(splats, camera_at(), backend="cuda")


@BACKENDS
def test_a_flat_gaussian_is_a_plane_that_leans(backend, dtype):
    """Every ray meets the plane z = 3 + x / 2, not the depth of the centre."""
    angle = math.atan(0.5)
    splats = Splats(
        means=torch.tensor([[0.0, 0.0, 3.0]], dtype=dtype),
        quats=torch.tensor([[math.cos(angle / 2), 0, -math.sin(angle / 2), 0]], dtype=dtype),
        log_scales=torch.log(torch.tensor([[1.0, 1.0, 1e-3]], dtype=dtype)),
        logit_opacities=torch.tensor([5.0], dtype=dtype),
        sh_dc=torch.zeros(1, 3, dtype=dtype), sh_rest=torch.zeros(1, 0, 3, dtype=dtype))
    camera = Camera(40, 30, 400.0, 400.0, 20.0, 15.0, np.eye(4))
    surface = render_surface(splats, camera, backend=backend)
    x = (torch.arange(40) + 0.5 - 20) / 400
    expected = (3 / (1 - x / 2)).expand(30, 40)
    assert torch.allclose(surface.depth, expected.to(dtype), rtol=1e-3)
    assert surface.cosine.mean().item() == pytest.approx(math.cos(angle), abs=0.01)


def test_a_pixel_without_a_gaussian_has_no_depth():
    splats = one_splat((0.0, 0.0, 2.0), scale=0.1, opacity=0.9, color=(1, 0, 0))
    surface = surface_of(splats, camera_at(4, 3), torch.full((3, 4), -1))
    assert not surface.depth.any()
    assert not surface.cosine.any()
