"""The triton backend's whole step of a view, in an interpreter or on a GPU, against float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from adam_runs import CONFIG, gradients_of
from interpreter import DEVICE
from scenes import camera_at, random_splats

from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.render.depth_loss import depth_loss
from recon_cli.render.response import Response
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.train_view import SensorDepth, TrainView
from recon_cli.train.fit.gradient import RENDERED_NOISE, gradient_step, photometric_loss
from recon_cli.train.fit.optimizer import SplatOptimizer

pytest.importorskip("triton", reason="triton is not installed")
WIDTH, HEIGHT = 18, 17  # four tiles, three of them cut by the border
CAMERA = camera_at(WIDTH, HEIGHT, focal=30.0)
DEGREE, WEIGHT, DEPTH_WEIGHT = 3, 0.2, 0.005
LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-6, 1e-4
GAIN = np.array([0.8, 1.1, 1.3], np.float32)
COUNT = 20
SEEN = random_splats(COUNT, seed=3).map(torch.Tensor.float)


def photograph():
    return np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def half():
    return np.random.default_rng(1).random((HEIGHT, WIDTH)) < 0.5


def step(splats, view, gain=None, **wanted):
    """The optimizer that a step leaves its gradients in, the step, loss and statistics."""
    optimizer = SplatOptimizer(
        splats.map(lambda tensor: tensor.clone().to(DEVICE)), CONFIG, 1.0, backend="triton")
    compute = gradient_step("triton", DEVICE)
    loss, statistics = compute(optimizer, view, StepOptions(DEGREE, WEIGHT, **wanted),
                               None if gain is None else Response(gain))
    return optimizer, compute, loss, statistics


def exact(splats, view, gain=None):
    """Loss, leaves with their gradients, gradient of the log-gain and statistics in float64."""
    leaves = splats.map(lambda tensor: tensor.detach().double().requires_grad_())
    counting = view.counting(torch.device("cpu"))
    out = render(leaves, view.camera, leaves.background, DEGREE, backend="torch", scores=True,
                 mask=counting)
    log_gain = torch.zeros(3, dtype=torch.float64) if gain is None else (
        torch.from_numpy(gain).double().log())
    log_gain.requires_grad_()
    truth = torch.from_numpy(view.image).double() / 255
    loss = photometric_loss(out.rgb * log_gain.exp(), truth, WEIGHT, mask=counting)
    if view.depth is not None:
        known = torch.from_numpy(view.depth.image(view.camera, view.mask)).double()
        noise = np.hypot(view.depth.noise, RENDERED_NOISE)
        loss = loss + depth_loss(out.depth, out.alpha, known, noise,
                                 DEPTH_WEIGHT / view.depth.cells)
    loss.backward()
    return loss.item(), leaves, log_gain.grad, out.statistics


def near(ours, theirs, tolerance=GRADIENT_TOLERANCE):
    error = (ours.detach().double().cpu() - theirs).norm()
    return error <= tolerance * max(theirs.norm(), 1e-12)


@pytest.mark.integration
@pytest.mark.parametrize(("mask", "gain"), [(None, None), (half(), GAIN)], ids=["plain", "both"])
def test_a_step_leaves_loss_gradients_and_statistics(mask, gain):
    view = TrainView(CAMERA, photograph(), mask)
    optimizer, compute, loss, statistics = step(
        SEEN, view, gain=gain, details=True, scores=True, loo=True)
    true_loss, leaves, true_gain, truth = exact(SEEN, view, gain)
    assert loss == pytest.approx(true_loss, abs=LOSS_TOLERANCE)
    for name, leaf in leaves.parameters().items():
        assert near(optimizer.gradient(name), leaf.grad), name
    for name in ("radii", "hits", "blend_sum", "blend_max", "means2d_grad", "variance", "loo"):
        assert near(getattr(statistics, name), getattr(truth, name).double()), name
    if gain is not None:
        assert near(torch.from_numpy(compute.response_gradient.log_gain), true_gain)


def depth():
    """What a sensor measures at every second pixel, more than half of it other than it is."""
    row, column = np.mgrid[0:HEIGHT:2, 0:WIDTH:2].reshape(2, -1)
    rays = np.stack([(column + 0.5 - CAMERA.cx) / CAMERA.fx,
                     (row + 0.5 - CAMERA.cy) / CAMERA.fy], 1)
    z = np.random.default_rng(2).uniform(1.5, 4, len(row))
    return SensorDepth(rays.astype(np.float32), z.astype(np.float32), 0.02, len(row))


@pytest.mark.integration
def test_a_step_with_sensor_depth_and_those_before_and_after_without_it():
    compute = gradient_step("triton", DEVICE)
    views = [TrainView(CAMERA, photograph(), half(), depth=one) for one in (None, depth(), None)]
    for view in views:
        optimizer = SplatOptimizer(
            SEEN.map(lambda tensor: tensor.clone().to(DEVICE)), CONFIG, 1.0, backend="triton")
        loss, _ = compute(
            optimizer, view, StepOptions(DEGREE, WEIGHT, depth_weight=DEPTH_WEIGHT))
        true_loss, leaves, *_ = exact(SEEN, view)
        assert loss == pytest.approx(true_loss, abs=LOSS_TOLERANCE)
        for name, leaf in leaves.parameters().items():
            assert near(optimizer.gradient(name), leaf.grad), name
    assert exact(SEEN, views[1])[0] > exact(SEEN, views[0])[0] + 1e-4


@pytest.mark.integration
def test_a_step_on_a_backdrop_has_its_colour_and_one_after_it_is_on_black_again():
    view = TrainView(CAMERA, photograph())
    on_grey = replace(SEEN, backdrop=Backdrop(0.2, 0.9, 0.4, 0.0, 0.0, 0.0, 1.0))
    compute = gradient_step("triton", DEVICE)
    for splats in (on_grey, SEEN, on_grey):
        optimizer = SplatOptimizer(
            splats.map(lambda tensor: tensor.clone().to(DEVICE)), CONFIG, 1.0, backend="triton")
        loss, _ = compute(optimizer, view, StepOptions(DEGREE, WEIGHT))
        true_loss, leaves, _, _ = exact(splats, view)
        assert loss == pytest.approx(true_loss, abs=LOSS_TOLERANCE)
        for name, leaf in leaves.parameters().items():
            assert near(optimizer.gradient(name), leaf.grad), name


@pytest.mark.integration
def test_a_view_that_sees_nothing_has_a_loss_and_no_gradient():
    behind = SEEN.map(torch.clone)
    behind.means = behind.means - torch.tensor([0.0, 0.0, 50.0])
    optimizer, compute, loss, statistics = step(behind, TrainView(CAMERA, photograph()))
    assert statistics is None
    assert loss == pytest.approx(exact(behind, TrainView(CAMERA, photograph()))[0], abs=1e-6)
    assert compute.counted.item() == 0
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc"):
        assert not optimizer.gradient(name).any(), name


@pytest.mark.integration
def test_a_view_under_a_mask_that_hides_all_moves_nothing():
    view = TrainView(CAMERA, photograph(), np.zeros((HEIGHT, WIDTH), bool))
    optimizer, _, loss, _ = step(SEEN, view)
    assert loss == 0
    assert not optimizer.gradient("means").any()


def test_adam_moves_as_torch_does_and_only_where_the_step_counts():
    counts = {one: torch.full((1,), one, dtype=torch.int32, device=DEVICE) for one in (0, 1)}
    ours, plain = (SplatOptimizer(
        SEEN.map(lambda tensor, to=to: tensor.clone().to(to)), CONFIG, 1.0, backend=backend)
        for backend, to in (("triton", DEVICE), ("torch", "cpu")))
    for number, counted in enumerate((1, 0, 1, 1, 0)):
        gradients = gradients_of(COUNT, number)
        for name, value in gradients.parameters().items():
            getattr(ours.gradients, name).copy_(value)
            getattr(plain.splats, name).grad = value.clone()
        ours.step(1e-4, counted=counts[counted])
        if counted:
            plain.step(1e-4)
    assert ours.count == plain.count == 3
    for name, value in plain.tensors().items():
        scale = value.abs().max().clamp_min(1e-12)
        assert ((ours.tensors()[name].cpu() - value).abs().max()) <= 1e-6 * scale, name
