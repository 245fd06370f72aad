"""`recon render --panorama`: level frames of all directions, without seams."""

import cv2
import numpy as np
import pytest
import torch
from facts import raises
from render_cli import pictures, render

from recon_cli.errors import ConfigError
from recon_cli.flythrough.panorama import panorama_camera, render_panorama
from recon_cli.flythrough.request import RenderRequest
from recon_cli.scene.camera import looking_at
from recon_cli.scene.splats import Splats

UP = np.array([0.0, 0.0, 1.0])


def ball(place, *, radius=0.3):
    """One opaque Gaussian."""
    return Splats(
        means=torch.tensor([place], dtype=torch.float32), quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), float(np.log(radius))),
        logit_opacities=torch.full((1,), 8.0), sh_dc=torch.ones(1, 3),
        sh_rest=torch.zeros(1, 0, 3))


@pytest.mark.parametrize(("place", "pixel"), [
    ((0, 3, 0), (32, 64)),  # ahead: the middle
    ((3, 0, 0), (32, 96)),  # to the right
    ((0, -3, 0), (32, 0)),  # behind: at both edges
    ((0, 3, 3), (16, 64)),  # up
    ((-3, 0, -3), (48, 32)),
])
def test_a_point_lies_where_the_projection_says_and_depth_is_its_distance(place, pixel):
    viewmat = looking_at(np.zeros(3), np.array([0.0, 1.0, 0.4]), UP)  # pitched: it is levelled
    camera = panorama_camera(viewmat, UP, 128)
    assert (camera.width, camera.height) == (128, 64)
    output = render_panorama(ball(place), camera, torch.zeros(3), 0, backend="torch")
    alpha, depth = output.alpha.numpy(), output.depth.numpy()
    y, x = np.indices(alpha.shape) + 0.5
    assert (alpha * y).sum() / alpha.sum() == pytest.approx(pixel[0], abs=1.2)
    around = np.angle((alpha * np.exp(2j * np.pi * (x - pixel[1]) / 128)).sum())
    assert around / (2 * np.pi) * 128 == pytest.approx(0, abs=1.2)
    inside = alpha > 0.9
    assert inside.any()
    np.testing.assert_allclose(
        depth[inside] / alpha[inside], np.linalg.norm(place), rtol=0.05)


def test_a_view_and_a_path_are_rendered_all_around(room, tmp_path):
    assert render(room, "--panorama", "--size", 128, "--views", "000001",
                  "--output", "rgb,depth", "--out", tmp_path / "view") == 0
    assert pictures(tmp_path / "view") == ["000001.png"]
    picture = cv2.imread(str(tmp_path / "view" / "rgb" / "000001.png"))
    assert picture.shape == (64, 128, 3)
    steps = np.abs(np.diff(picture.astype(float), axis=1)).mean()
    seam = np.abs(picture[:, 0].astype(float) - picture[:, -1]).mean()
    assert seam <= 3 * steps


def test_a_panorama_is_twice_as_wide_as_high():
    with raises(ConfigError, "wide", "high"):
        RenderRequest(panorama=True, width=100, height=100)
    RenderRequest(panorama=True, width=200, height=100)
