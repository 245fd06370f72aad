"""Colours of a lower degree: the least squares over what the views see."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import camera_at, one_splat, random_splats, with_harmonics

from recon_cli.export.reduce import LowerDegrees
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0

BLACK = torch.zeros(3, dtype=torch.float64)


def cameras(*places: float) -> list[Camera]:
    """Cameras beside each other that look along +z."""
    found = []
    for x in places:
        viewmat = np.eye(4)
        viewmat[0, 3] = -x
        found.append(dataclasses.replace(camera_at(), viewmat=viewmat))
    return found


def colored_splat(mean=(0.0, 0.0, 3.0), *, seed=1):
    splat = one_splat(mean, scale=0.2, opacity=0.9, color=(0.5, 0.4, 0.6))
    noise = torch.from_numpy(np.random.default_rng(seed).normal(0, 0.05, (1, 15, 3)))
    return dataclasses.replace(splat, sh_rest=noise)


def values(splats, camera, weight=1.0):
    """The weighted basis and colour of the only Gaussian towards a camera, float64."""
    away = torch.nn.functional.normalize(splats.means - torch.from_numpy(camera.center), dim=1)
    row = torch.cat([torch.full((1, 1), SH_C0, dtype=torch.float64), basis_rest(away, 3)], 1)[0]
    whole = torch.cat([splats.sh_dc, splats.sh_rest[0]])
    return weight**0.5 * row, weight**0.5 * (row @ whole)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_one_view_sees_the_same_picture_in_every_degree(degree):
    splats, (camera,) = colored_splat(), cameras(0.4)
    lower = LowerDegrees(splats, [camera], backend="torch").at(degree)
    assert lower.sh_degree == degree
    expected, found = (
        render(scene, camera, BLACK, scene.sh_degree).rgb for scene in (splats, lower))
    cut = render(splats.with_degree(degree), camera, BLACK, degree).rgb
    assert (found - expected).abs().max() < 2e-4 < (cut - expected).abs().max()


@pytest.mark.parametrize("degree", [0, 1])
def test_colours_are_the_least_squares_over_the_views(degree):
    splats, views = colored_splat(), cameras(-1.5, -0.5, 0.2, 0.9, 2.0)
    weights = [render(splats, camera, BLACK, 0, scores=True).statistics.blend_sum.item()
               for camera in views]
    rows, seen = zip(*(values(splats, *pair) for pair in zip(views, weights, strict=True)),
                     strict=True)
    low = (degree + 1) ** 2
    ridge = 1e-3 * sum(weights) * torch.eye(low, dtype=torch.float64)
    ridge[0, 0] = 0
    basis, colors = torch.stack(rows)[:, :low], torch.stack(seen)
    expected = torch.linalg.solve(basis.T @ basis + ridge, basis.T @ colors)
    lower = LowerDegrees(splats, views, backend="torch").at(degree)
    found = torch.cat([lower.sh_dc[:, None], lower.sh_rest], 1)[0]
    assert torch.allclose(found.double(), expected, atol=1e-5)


def test_what_no_view_sees_is_cut_and_what_has_no_harmonics_stays():
    splats = with_harmonics(random_splats(40).map(lambda tensor: tensor.float()), 3, 30)
    behind = dataclasses.replace(
        splats, means=splats.means * torch.tensor([1.0, 1.0, -1.0]) - torch.tensor([0, 0, 9.0]))
    lower = LowerDegrees(behind, cameras(0.0), backend="torch").at(1)
    assert torch.equal(lower.sh_dc, splats.sh_dc)
    assert torch.equal(lower.sh_rest, splats.sh_rest[:, :3])
    seen = LowerDegrees(splats, cameras(0.0, 0.5), backend="torch").at(1)
    assert torch.allclose(seen.sh_dc[30:], splats.sh_dc[30:], atol=1e-5)
    assert not torch.allclose(seen.sh_dc[:30], splats.sh_dc[:30], atol=1e-3)
    assert seen.sh_rest.shape == (30, 3, 3)


def test_its_own_degree_is_the_scene_itself():
    splats = colored_splat()
    assert LowerDegrees(splats, cameras(0.0), backend="torch").at(3) is splats
