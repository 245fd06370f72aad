"""bench_error_split on made errors whose shares are known in closed form."""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
import bench_error_split as split

SIZE = 96, 64
CAMERA = Camera(*SIZE, 90.0, 90.0, 48.0, 32.0, np.eye(4))
NOWHERE = np.zeros((64, 96), bool)


def draw(camera):
    """Draws smooth waves on the plane z = 2, whose depth and colour are known in every pixel."""
    columns, lines = np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5)
    rays = np.stack([(columns - camera.cx) / camera.fx, (lines - camera.cy) / camera.fy,
                     np.ones_like(columns)], axis=-1) @ camera.viewmat[:3, :3]
    depth = (2 - camera.center[2]) / rays[..., 2]
    x, y, _ = np.moveaxis(camera.center + rays * depth[..., None], -1, 0)
    waves = [np.sin(11 * x + phase) * np.sin(9 * y + 2 * phase) for phase in (0.3, 1.1, 2.0)]
    # fine ones as well: of one wave alone, a blur and a flatter tone curve look the same
    fine = 0.12 * np.sin(27 * x + 1) * np.sin(33 * y)
    return 0.5 + 0.25 * np.stack(waves, axis=-1) + fine[..., None], depth


def view_of(image):
    return TrainView(CAMERA, np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))


def shares(photo, few=NOWHERE, moves=NOWHERE):
    result = split.split_view(draw, view_of(photo), few, moves)
    assert sum(result.parts) == pytest.approx(result.error)
    return dict(zip(split.CAUSES, np.array(result.parts) / result.error, strict=True))


def test_a_gain_takes_the_whole_error():
    found = shares(draw(CAMERA)[0] * [1.15, 1.1, 0.9])
    assert found["gain"] > 0.95


def test_a_tone_curve_is_told_from_a_gain():
    render = draw(CAMERA)[0]
    found = shares(render + 0.4 * (render - 0.5) ** 2)
    assert found["tone curve"] > 0.5
    assert found["tone curve"] + found["gain"] > 0.95


def test_a_turned_and_shifted_camera_takes_the_whole_error():
    moved = replace(CAMERA, viewmat=split._motion(np.array([.004, -.006, .01, .02, -.01, .02]))
                    @ CAMERA.viewmat)
    assert shares(draw(moved)[0])["pose"] > 0.97


@pytest.mark.parametrize("sigmas", [(1.0, 1.0), (2.0, 0.01)])
def test_a_blurred_photo_is_explained_by_blur_in_any_direction(sigmas):
    photo = cv2.GaussianBlur(draw(CAMERA)[0], (0, 0), sigmas[0], sigmaY=sigmas[1],
                             borderType=cv2.BORDER_REPLICATE)
    found = shares(photo)
    # waves also get flatter, which a tone curve explains in part, and the curve comes first
    assert found["blur"] > 0.35
    assert found["gain"] + found["tone curve"] + found["blur"] > 0.95
    assert split.split_view(draw, view_of(photo), NOWHERE, NOWHERE).sharpness < 0.95


def test_noise_is_the_rest():
    noise = np.random.default_rng(0).normal(0, 0.05, (64, 96, 3))
    assert shares(draw(CAMERA)[0] + noise)["rest"] > 0.97


def test_regions_take_what_they_have_beyond_the_other_pixels():
    noise = np.where(np.random.default_rng(1).random((64, 96, 1)) < 0.5, 0.04, -0.04)
    moves, few = NOWHERE.copy(), NOWHERE.copy()
    moves[10:30, 20:50], few[40:50, 60:90] = True, True
    size = np.where(moves, 5.0, np.where(few, 3.0, 1.0))[..., None]
    found = shares(draw(CAMERA)[0] + noise * size, few, moves)
    total = 600 * 25 + 300 * 9 + (64 * 96 - 900)
    assert found["moving"] == pytest.approx(600 * 24 / total, abs=0.02)
    assert found["few views"] == pytest.approx(300 * 8 / total, abs=0.02)
    assert found["rest"] == pytest.approx(64 * 96 / total, abs=0.03)


def test_two_causes_get_their_own_shares():
    noise = np.random.default_rng(0).normal(0, 0.04, (64, 96, 3))
    render = draw(CAMERA)[0]
    gain_error, noise_error = ((0.12 * render) ** 2).mean(), 0.04**2
    found = shares(render * 0.88 + noise)
    assert found["gain"] == pytest.approx(gain_error / (gain_error + noise_error), abs=0.03)
    assert found["rest"] == pytest.approx(noise_error / (gain_error + noise_error), abs=0.03)
