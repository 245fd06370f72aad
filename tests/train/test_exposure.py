"""Gains of the training images: their gradient, their gauge, and that they find the camera's."""

import numpy as np
import pytest
import torch
from scenes import camera_at, random_splats

from recon_cli.config.stages import TrainConfig
from recon_cli.io.images import fill_masked
from recon_cli.kernels.thread_pool import pool
from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.render.response import Response, ResponseGradient
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.gradient import gradient_step, photometric_loss
from recon_cli.train.fit.state import new_state
from recon_cli.train.parts.exposure import Exposure

# Gradients of float32 against float64, relative in the 2-norm, as in test_gradient.
TOLERANCE = 1e-5
CONFIG = TrainConfig(iterations=10, max_gaussians=300)
CAMERA = camera_at(60, 41)
GAIN = np.array([1.3, 1.0, 0.8], np.float32)
every_cpu_backend = pytest.mark.parametrize("backend", ["torch", "numba"])


def photograph(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (41, 60, 3), np.uint8)


def masked_view():
    mask = np.ones((41, 60), bool)
    mask[8:25, 20:41] = False
    return TrainView(CAMERA, fill_masked(photograph(), mask), mask)


def step_of(splats, view, backend, gain):
    """Loss, gradients of the splats and of the log-gain that a step leaves."""
    state = new_state(splats, CONFIG, 1.0, backend=backend)
    compute = gradient_step(backend)
    response = None if gain is None else Response(gain)
    loss, _ = compute(state.optimizer, view, StepOptions(3, 0.2), response)
    held = state.optimizer.gradients.parameters().items()
    if not state.optimizer.fused:
        held = ((name, leaf.grad) for name, leaf in state.splats.parameters().items())
    return loss, {name: value.clone() for name, value in held}, (
        compute.response_gradient.log_gain)


def exact_loss(splats, view, log_gain, ssim_weight=0.2):
    """The loss in float64, of an image that is the truth where it is ignored."""
    rgb = render(splats, view.camera, torch.zeros(3, dtype=torch.float64), 3, backend="torch").rgb
    truth = torch.from_numpy(view.image).double() / 255
    counts = torch.ones(41, 60) if view.mask is None else torch.from_numpy(view.mask)
    counts = counts.double()[..., None]
    return photometric_loss(
        counts * rgb * log_gain.exp() + (1 - counts) * truth, truth, ssim_weight)


@every_cpu_backend
@pytest.mark.parametrize("view", [TrainView(CAMERA, photograph()), masked_view()],
                         ids=["whole", "masked"])
def test_a_step_with_a_gain_gives_the_gradients_of_the_loss_behind_it(backend, view):
    splats = random_splats(200, seed=13, dtype=torch.float32)
    loss, gradients, of_gain = step_of(splats, view, backend, GAIN)
    leaves = splats.map(lambda tensor: tensor.detach().double().requires_grad_())
    log_gain = torch.from_numpy(GAIN).double().log().requires_grad_()
    expected = exact_loss(leaves, view, log_gain)
    expected.backward()
    assert loss == pytest.approx(expected.item(), abs=1e-6)
    truth = log_gain.grad.numpy()
    assert np.linalg.norm(of_gain - truth) <= TOLERANCE * np.linalg.norm(truth)
    for name, value in gradients.items():
        theirs = getattr(leaves, name).grad
        assert (value.double() - theirs).norm() <= TOLERANCE * theirs.norm(), name


@every_cpu_backend
def test_the_gradient_of_the_gain_is_the_slope_of_the_loss(backend):
    splats = random_splats(200, seed=13)
    view, reach = masked_view(), 1e-6  # so small that no pixel crosses the truth
    _, _, of_gain = step_of(splats.map(torch.Tensor.float), view, backend, GAIN)
    middle = torch.from_numpy(GAIN).double().log()
    for channel in range(3):
        move = torch.zeros(3, dtype=torch.float64)
        move[channel] = reach
        with torch.no_grad():
            slope = (exact_loss(splats, view, middle + move)
                     - exact_loss(splats, view, middle - move)) / (2 * reach)
        assert of_gain[channel] == pytest.approx(slope.item(), rel=1e-4)


@every_cpu_backend
def test_a_white_picture_of_a_gray_room_has_the_slope_of_its_brightness(backend):
    # L1 alone of a picture that is darker than the photograph all over: dL/dlog g = -mean of g x
    splats = random_splats(200, seed=13, dtype=torch.float32)
    view = TrainView(CAMERA, np.full((41, 60, 3), 255, np.uint8))
    gain = np.array([0.1, 0.2, 0.05], np.float32)
    state = new_state(splats, CONFIG, 1.0, backend=backend)
    compute = gradient_step(backend)
    compute(state.optimizer, view, StepOptions(3, 0.0), Response(gain))
    with torch.no_grad():
        rgb = render(splats, CAMERA, torch.zeros(3), 3, backend=backend).rgb.numpy()
    assert rgb.max() * gain.max() < 1
    expected = -(rgb * gain).reshape(-1, 3).mean(axis=0) / 3
    assert compute.response_gradient.log_gain == pytest.approx(expected, rel=1e-4)


@every_cpu_backend
def test_a_gain_of_one_changes_no_gradient(backend):
    splats = random_splats(200, seed=13, dtype=torch.float32)
    view = TrainView(CAMERA, photograph())
    plain = step_of(splats, view, backend, None)
    with_gain = step_of(splats, view, backend, np.ones(3, np.float32))
    assert plain[0] == with_gain[0]
    assert all(torch.equal(plain[1][name], with_gain[1][name]) for name in plain[1])


def test_any_number_of_threads_gives_the_same_gradient_of_the_gain(monkeypatch):
    splats, found = random_splats(200, seed=13, dtype=torch.float32), []
    for threads in (1, 2, 3):
        monkeypatch.setattr(pool, "threads", threads)
        found.append(step_of(splats, masked_view(), "numba", GAIN)[2])
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_a_view_that_is_ignored_altogether_has_no_gradient_of_the_gain():
    view = TrainView(CAMERA, photograph(), np.zeros((41, 60), bool))
    splats = random_splats(50, dtype=torch.float32)
    assert not step_of(splats, view, "numba", GAIN)[2].any()


def pull(log_gain):
    return ResponseGradient(log_gain, np.zeros(2))


def stepped(exposure, steps=300, images=4, seed=0):
    """Pulls the log-gains of the first images towards a truth by the sign of what is missing."""
    truth = np.random.default_rng(seed).normal(0, 0.2, (images, 3))
    for i in range(steps):
        image = i % images
        exposure.step(image, pull(exposure.log_gains[image] - truth[image]), i / steps)
    return truth


@pytest.mark.integration
def test_gains_are_found_up_to_their_mean():
    exposure = Exposure(4)
    truth = stepped(exposure, 3000)
    assert exposure.log_gains == pytest.approx(truth - truth.mean(axis=0), abs=0.02)


def test_the_mean_log_gain_stays_zero():
    exposure = Exposure(5, start=np.random.default_rng(1).normal(1, 0.2, (5, 3)))
    for steps in (0, 1, 7):
        stepped(exposure, steps, images=5)
        assert exposure.log_gains.mean(axis=0) == pytest.approx(0, abs=1e-12)


def test_an_image_that_is_never_seen_keeps_its_gain():
    exposure = Exposure(5)
    stepped(exposure, images=4)
    assert np.array_equal(exposure.gain(4), np.ones(3, np.float32))


def test_a_gradient_that_is_not_finite_moves_nothing():
    exposure = Exposure(2)
    exposure.step(0, pull(np.array([np.nan, 0.0, 1.0])), 0.0)
    assert not exposure.log_gains.any()


def test_gains_that_go_on_from_a_checkpoint_are_the_same_to_the_bit():
    whole, part = Exposure(4), Exposure(4)
    stepped(whole, 30)
    stepped(part, 30)
    resumed = Exposure(4)
    resumed.restore({name: value.clone() for name, value in part.tensors().items()})
    stepped(whole, 30, seed=1)
    stepped(resumed, 30, seed=1)
    assert np.array_equal(whole.log_gains, resumed.log_gains)
