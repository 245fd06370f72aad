"""The response of a camera: closed forms, and gradients against autograd in float64."""

import numpy as np
import pytest
import torch
from scenes import camera_at

from recon_cli.render.response import (
    LensFalloffs,
    Response,
    ResponsePass,
    ResponseTensors,
    lens,
    squared_distances,
    transmission,
)

CAMERA = camera_at(24, 17)
RESPONSES = {
    "gain": Response(np.array([1.3, 1.0, 0.8], np.float32)),
    "vignette": Response(np.array([1.1, 1.0, 0.9], np.float32), vignette=(-0.3, -0.2))}
TOLERANCE = 1e-5  # of float32 against float64, relative in the 2-norm


def picture(seed):
    return np.random.default_rng(seed).uniform(-0.1, 1.3, (17, 24, 3)).astype(np.float32)


def test_a_vignette_takes_nothing_at_the_principal_point_and_its_exponents_at_the_corner():
    camera = camera_at(25, 17)
    left = transmission(camera, (-0.3, -0.2))
    squares = squared_distances(camera)
    row, column = np.unravel_index(squares.argmin(), squares.shape)
    assert abs(column + 0.5 - camera.cx) <= 0.5
    assert abs(row + 0.5 - camera.cy) <= 0.5
    assert left.max() == left[row, column] == pytest.approx(1, abs=1e-3)
    assert squares.max() <= 1
    assert np.log(left) == pytest.approx(-0.3 * squares - 0.2 * squares**2, abs=1e-6)


@pytest.mark.parametrize("name", RESPONSES)
def test_the_closed_form_has_the_gradients_of_float64(name):
    response, render, pull = RESPONSES[name], picture(1), picture(2)
    leaf = torch.from_numpy(render).double().requires_grad_()
    tensors = ResponseTensors(response, CAMERA, leaf)
    expected = tensors.apply(leaf)
    (expected * torch.from_numpy(pull).double()).sum().backward()
    image, gradient = render.copy().reshape(17, -1), pull.copy().reshape(17, -1)
    closed = ResponsePass(response, CAMERA)
    closed.forward(image)
    assert image.reshape(render.shape) == pytest.approx(expected.detach().numpy(), abs=1e-6)
    found, truth = closed.backward(image, gradient), tensors.gradient()
    assert np.linalg.norm(gradient.reshape(render.shape) - leaf.grad.numpy()) <= (
        TOLERANCE * np.linalg.norm(leaf.grad.numpy()))
    for ours, theirs in ((found.log_gain, truth.log_gain), (found.vignette, truth.vignette)):
        assert np.linalg.norm(ours - theirs) <= TOLERANCE * max(np.linalg.norm(theirs), 1)


def test_the_gradients_are_slopes():
    render, pull, reach = picture(3).astype(np.float64), picture(4).astype(np.float64), 1e-6

    def value(log_gain, a, b):
        squares = squared_distances(CAMERA).astype(np.float64)[..., None]
        light = render * np.exp(np.asarray(log_gain) + a * squares + b * squares**2)
        return float((light * pull).sum())

    response = Response(np.exp([0.1, 0.0, -0.1]).astype(np.float32), (-0.3, -0.2))
    log_gain = np.log(response.gain.astype(np.float64))
    leaf = torch.from_numpy(render)
    tensors = ResponseTensors(response, CAMERA, leaf)
    (tensors.apply(leaf) * torch.from_numpy(pull)).sum().backward()
    found = tensors.gradient()
    places = np.array([*log_gain, -0.3, -0.2])
    for axis, slope in enumerate([*found.log_gain, *found.vignette]):
        move = reach * np.eye(5)[axis]
        ends = [value(at[:3], *at[3:]) for at in (places + move, places - move)]
        assert slope == pytest.approx((ends[0] - ends[1]) / (2 * reach), rel=1e-4, abs=1e-4)


@pytest.mark.integration
def test_a_lens_has_its_vignette_at_any_size_and_no_other_lens_has_it():
    falloffs = LensFalloffs({lens(camera_at(640, 480, focal=500.0)): (-0.4, 0.0)})
    half, other = camera_at(320, 240, focal=250.0), camera_at(320, 240, focal=400.0)
    white = np.ones((240, 320, 3), np.float32)
    shaded = falloffs.shade(white, half)
    assert shaded[..., 1] == pytest.approx(transmission(half, (-0.4, 0.0)))
    assert shaded.min() == pytest.approx(np.exp(-0.4), abs=0.01)
    assert np.array_equal(falloffs.shade(white, other), white)
    tensor = falloffs.shade_tensor(torch.from_numpy(white), half)
    assert np.array_equal(tensor.numpy(), shaded)
