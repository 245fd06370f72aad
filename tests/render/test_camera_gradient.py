"""The gradient of a camera's motion: in closed form, against central differences, by backend."""

import numpy as np
import pytest
import torch
from scenes import camera_at, leaves, move_camera, one_splat, random_splats

from recon_cli.config.stages import TrainConfig
from recon_cli.kernels.thread_pool import pool
from recon_cli.render import render
from recon_cli.render.camera_gradient import camera_gradient
from recon_cli.render.contract import StepOptions
from recon_cli.render.numba import step as numba_step
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.train.gradient import gradient_step, photometric_loss
from recon_cli.train.state import new_state

BLACK = torch.zeros(3, dtype=torch.float64)
CONFIG = TrainConfig(iterations=10, max_gaussians=6000)
every_way = pytest.mark.parametrize(
    "gradient", [camera_gradient, numba_step.camera_gradient], ids=["torch", "numba"])

# Central differences against a float64 gradient. Their reach must be so small that no Gaussian
# reaches or leaves a pixel, where its alpha jumps by 1/255; the loss is then good to 1e-8 of them.
EXACT, REACH = 1e-5, 1e-8
# Where a Gaussian is cut off at alpha = 1/255 the border moves too, which no gradient holds: a
# share (r^2/2) exp(-r^2/2) = .024 of the shift, with exp(-r^2/2) = 1 / (255 x .9).
CUT_OFF = 0.025
SINGLE = 1e-4  # float32 gradients; measured 7e-6


def photograph(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (37, 50, 3), np.uint8)


def loss_of(splats, camera, degree):
    rgb = render(splats, camera, BLACK, degree, backend="torch").rgb
    return photometric_loss(rgb, torch.from_numpy(photograph()).double() / 255, 0.2)


def gradients_of(splats, camera, degree):
    held = leaves(splats)
    loss_of(held, camera, degree).backward()
    return collected(held)


def collected(held):
    """The gradients that autograd left; zeros where there are none."""
    return held.map(lambda leaf: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)


def after_a_step(splats, camera, degree):
    state = new_state(splats, CONFIG, 1.0, backend="numba")
    gradient_step("numba")(
        state.optimizer, TrainView(camera, photograph()), StepOptions(degree, 0.2))
    return state.optimizer.splats, state.optimizer.gradients


def slopes(splats, camera, degree, reach=REACH):
    """Central differences of the loss over the six motions of the camera."""
    result = np.empty(6)
    for k in range(6):
        step = np.zeros(6)
        step[k] = reach
        with torch.no_grad():
            ahead, behind = (loss_of(splats, move_camera(camera, s[:3], s[3:]), degree).item()
                             for s in (step, -step))
        result[k] = (ahead - behind) / (2 * reach)
    return result


def test_a_picture_shifts_as_the_camera_turns_and_moves():
    # one small Gaussian ahead, L = sum of column x brightness: a shift of the picture by s pixels
    # changes L by s times the brightness. A turn by w about y (down) looks to the right, s = -f w;
    # a move to the right by v gives s = -f v / z. A roll about the axis of view changes nothing.
    focal, z = 60.0, 3.0
    camera = Camera(41, 41, focal, focal, 20.5, 20.5, np.eye(4))
    splats = leaves(one_splat((0.0, 0.0, z), scale=0.05, opacity=0.9, color=(0.5, 0.5, 0.5)))
    rgb = render(splats, camera, BLACK, 0, backend="torch").rgb
    columns = torch.arange(41.0, dtype=torch.float64)[None, :, None]
    (rgb * columns).sum().backward()
    gradient = camera_gradient(splats, collected(splats), camera, 0)
    brightness = rgb.detach().sum().item()
    assert gradient[1] == pytest.approx(-focal * brightness, rel=CUT_OFF)
    assert gradient[3] == pytest.approx(-focal / z * brightness, rel=CUT_OFF)
    assert gradient[2] == pytest.approx(0, abs=1e-9 * focal * brightness)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_gradient_is_the_slope_of_the_loss_over_the_camera(degree):
    splats, camera = random_splats(150, seed=5), camera_at()
    found = camera_gradient(splats, gradients_of(splats, camera, degree), camera, degree)
    expected = slopes(splats, camera, degree)
    for part in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(found[part] - expected[part])
        assert error <= EXACT * np.linalg.norm(expected[part])


def test_without_the_part_of_the_colours_a_turn_would_be_wrong():
    splats, camera = random_splats(150, seed=5), camera_at()
    gradients = gradients_of(splats, camera, 3)
    right, wrong = (camera_gradient(splats, gradients, camera, degree) for degree in (3, 0))
    assert np.linalg.norm(right[:3] - wrong[:3]) > 100 * EXACT * np.linalg.norm(right[:3])
    assert np.array_equal(right[3:], wrong[3:])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@every_way
def test_a_step_leaves_the_gradient_of_its_camera(gradient, degree):
    splats, camera = random_splats(5000, seed=5), camera_at()
    exact = camera_gradient(splats, gradients_of(splats, camera, degree), camera, degree)
    values, slopes = after_a_step(splats.map(torch.Tensor.float), camera, degree)
    found = gradient(values, slopes, camera, degree)
    for part in (slice(0, 3), slice(3, 6)):
        assert np.linalg.norm(found[part] - exact[part]) <= SINGLE * np.linalg.norm(exact[part])


@every_way
def test_any_number_of_threads_gives_the_same_gradient(gradient, monkeypatch):
    values, slopes = after_a_step(random_splats(5000, seed=5, dtype=torch.float32), camera_at(), 3)
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            monkeypatch.setattr(pool, "threads", threads)
            torch.set_num_threads(threads)
            found.append(gradient(values, slopes, camera_at(), 3))
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])
