"""Vignettes that colours of sparse points show, before any training."""

from dataclasses import replace

import numpy as np
import pytest

from recon_cli.render.response import Response, ResponsePass
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.train.parts.vignette import find_vignettes

WIDTH, HEIGHT, DEPTH = 120, 90, 3.0
CAMERA = Camera(WIDTH, HEIGHT, 100.0, 100.0, WIDTH / 2, HEIGHT / 2, np.eye(4))


def colors(x, y):
    """Smooth colours of a wall, dark and bright ones in every view."""
    waves = np.stack([np.sin(3 * x + y), np.cos(2 * y - x), np.sin(2 * x + 3 * y)], axis=-1)
    return 0.5 + 0.3 * waves


def shot(at, response):
    """A view of the wall from a place along it."""
    viewmat = np.eye(4)
    viewmat[:2, 3] = -np.asarray(at)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (u - CAMERA.cx) / 100 * DEPTH + at[0], (v - CAMERA.cy) / 100 * DEPTH + at[1]
    image = colors(x, y).astype(np.float32).reshape(HEIGHT, -1)
    ResponsePass(response, CAMERA).forward(image)
    pixels = np.rint(255 * image.reshape(HEIGHT, WIDTH, 3).clip(0, 1)).astype(np.uint8)
    return TrainView(replace(CAMERA, viewmat=viewmat), pixels)


def shots(responses):
    rng = np.random.default_rng(1)
    return [shot(rng.uniform(-1, 1, 2), response) for response in responses]


def points():
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform([-2.8, -2.3], [2.8, 2.3], (3000, 2)),
                            np.full(3000, DEPTH)])


def flexed(pixels, bend):
    """The picture after a tone curve that keeps black and white."""
    light = pixels / 255
    return np.rint(255 * (light + bend * light * (1 - light))).astype(np.uint8)


def gain(seed):
    return np.exp(np.random.default_rng(seed).normal(0, 0.1, 3)).astype(np.float32)


def test_a_known_vignette_is_found_whatever_the_gains():
    responses = [Response(gain(i), vignette=(-0.25, -0.15)) for i in range(16)]
    found = find_vignettes(shots(responses), points())
    assert found.exponents.sum(axis=1) == pytest.approx([-0.4], abs=0.03)
    assert found.exponents[0, 0] * 0.5 + found.exponents[0, 1] * 0.25 == pytest.approx(
        -0.25 * 0.5 - 0.15 * 0.25, abs=0.02)  # half way to the corner
    assert found.shades


@pytest.mark.parametrize("bent", [0.0, 0.25])
def test_gains_and_tone_curves_are_no_vignette(bent):
    bends = np.random.default_rng(3).uniform(-bent, bent, 16)
    views = [replace(view, stored=flexed(view.image, bend)) for view, bend in zip(
        shots([Response(gain(i)) for i in range(16)]), bends, strict=True)]
    assert not find_vignettes(views, points()).shades


def test_corners_that_are_brighter_are_no_vignette():
    found = find_vignettes(shots([
        Response(np.full(3, 0.7, np.float32), vignette=(0.2, 0.1))] * 12), points())
    assert found.corner_loss == 0


def test_each_camera_has_a_vignette_of_its_own():
    other = replace(CAMERA, fx=80.0, fy=80.0)
    dark = shots([Response(gain(i), vignette=(-0.4, 0.0)) for i in range(12)])
    clear = [replace(view, camera=replace(other, viewmat=view.camera.viewmat))
             for view in shots([Response(gain(i)) for i in range(12)])]
    found = find_vignettes([*dark, *clear], points())
    assert found.exponents[0].sum() == pytest.approx(-0.4, abs=0.04)
    assert found.exponents.shape == (2, 2)


def test_without_points_nothing_is_found():
    found = find_vignettes(shots([Response(gain(0))] * 3), np.zeros((0, 3)))
    assert found.corner_loss == 0
