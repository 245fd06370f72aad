"""Masks in a training step, on every backend: what they ignore moves nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from facts import raises
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.config.stages import RunConfig
from recon_cli.io.images import fill_masked
from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.gradient import gradient_step, photometric_loss
from recon_cli.train.fit.state import new_state

# Gradients of float32 against float64, relative in the 2-norm. Measured 3e-6 (torch), 8e-7 (numba).
TOLERANCE = 1e-5
CONFIG = RunConfig(iterations=10, max_gaussians=300)
CAMERA = camera_at(60, 41)
BACKDROP = Backdrop(0.9, 0.2, 0.5, 0.0, 0.0, 0.0, 1.0)
every_cpu_backend = pytest.mark.parametrize("backend", ["torch", "numba"])


def blob_mask():
    """A mask [41, 60] with a rectangle, a lone pixel and a part of the border left out."""
    mask = np.ones((41, 60), bool)
    mask[8:25, 20:41] = False
    mask[33, 50] = False
    mask[:, :3] = False
    return mask


def photograph(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (41, 60, 3), np.uint8)


def gradients_of(splats, view, backend, degree=3):
    """The loss and the gradients that a step leaves in the optimizer."""
    state = new_state(splats, CONFIG, 1.0, backend=backend)
    loss, statistics = gradient_step(backend)(
        state.optimizer, view, StepOptions(degree, 0.2))
    held = state.optimizer.gradients.parameters().items()
    if not state.optimizer.fused:
        held = ((name, leaf.grad) for name, leaf in state.splats.parameters().items())
    return loss, {name: value.clone() for name, value in held}, statistics


def exact(splats, view, degree=3):
    """The same by autograd in float64, on the loss of an image that is the truth when ignored."""
    leaves = splats.map(lambda tensor: tensor.detach().double().requires_grad_())
    rgb = render(leaves, view.camera, leaves.background, degree, backend="torch").rgb
    truth = torch.from_numpy(view.image).double() / 255
    counts = torch.from_numpy(view.mask).double()[..., None]
    loss = photometric_loss(counts * rgb + (1 - counts) * truth, truth, 0.2)
    loss.backward()
    return loss.item(), {name: leaf.grad for name, leaf in leaves.parameters().items()}


@pytest.mark.parametrize("backdrop", [None, BACKDROP])
@every_cpu_backend
def test_a_masked_step_gives_the_gradients_of_the_masked_loss(backend, backdrop):
    splats = replace(random_splats(200, seed=13, dtype=torch.float32), backdrop=backdrop)
    mask = blob_mask()
    view = TrainView(CAMERA, fill_masked(photograph(), mask), mask)
    loss, gradients, _ = gradients_of(splats, view, backend)
    true_loss, expected = exact(splats, view)
    assert loss == pytest.approx(true_loss, abs=1e-6)
    for name, value in gradients.items():
        theirs = expected[name]
        assert (value.double() - theirs).norm() <= TOLERANCE * theirs.norm(), name


@every_cpu_backend
def test_a_mask_where_all_counts_changes_no_bit(backend):
    splats = random_splats(200, seed=13, dtype=torch.float32)
    plain = gradients_of(splats, TrainView(CAMERA, photograph()), backend)
    masked = gradients_of(
        splats, TrainView(CAMERA, photograph(), np.ones((41, 60), bool)), backend)
    assert plain[0] == masked[0]
    assert all(torch.equal(plain[1][name], masked[1][name]) for name in plain[1])


@every_cpu_backend
def test_what_the_photograph_shows_under_the_mask_changes_nothing(backend):
    splats = random_splats(200, seed=13, dtype=torch.float32)
    mask, results = blob_mask(), []
    for seed in (1, 2):
        image = photograph()
        image[~mask] = photograph(seed)[~mask]
        view = TrainView(CAMERA, fill_masked(image, mask), mask)
        results.append(gradients_of(splats, view, backend))
    assert results[0][0] == results[1][0]
    assert all(torch.equal(results[0][1][name], results[1][1][name]) for name in results[0][1])


@every_cpu_backend
def test_a_gaussian_seen_only_under_the_mask_gets_no_gradient_and_moves_no_other(backend):
    # seen at about column 33, row 17, some pixels wide
    hidden = [one_splat((0.0, 0.0, 2.0), scale=0.05, opacity=0.9, color=color, dtype=torch.float32)
              for color in ((1.0, 0.0, 0.0), (0.0, 0.3, 0.9))]
    others = random_splats(100, seed=13, dtype=torch.float32)
    mask = blob_mask()
    view = TrainView(CAMERA, fill_masked(photograph(), mask), mask)
    results = [gradients_of(joined(others, each), view, backend) for each in hidden]
    for loss, gradients, statistics in results:
        assert loss == results[0][0]
        assert statistics.radii[-1] > 0
        assert not statistics.means2d_grad[-1].any()
        for name, value in gradients.items():
            assert not value[-1].any(), name
            assert torch.equal(value[:-1], results[0][1][name][:-1]), name
    unmasked = gradients_of(joined(others, hidden[0]), TrainView(CAMERA, photograph()), backend)
    assert unmasked[1]["sh_dc"][-1].any()


@every_cpu_backend
def test_a_view_that_is_ignored_altogether_has_no_loss_and_no_gradient(backend):
    mask = np.zeros((41, 60), bool)
    view = TrainView(CAMERA, fill_masked(photograph(), mask), mask)
    loss, gradients, _ = gradients_of(random_splats(50, dtype=torch.float32), view, backend)
    assert loss == pytest.approx(0, abs=1e-6)
    assert not any(value.any() for value in gradients.values())


def test_a_mask_that_lies_on_its_side_is_refused():
    with raises(ValueError, "mask", (60, 41)):
        TrainView(CAMERA, photograph(), blob_mask().T)
