"""The triton backend's loss against the definition in torch, in an interpreter or on a GPU."""

import pytest
import torch
from adam_runs import CONFIG
from scenes import camera_at, random_splats

from recon_cli.train.losses import photometric_loss
from recon_cli.train.optimizer import SplatOptimizer
from recon_cli.train.step import TrainView, gradient_step

loss_module = pytest.importorskip("recon_cli.render.triton.loss", reason="triton is not installed")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
# float32; variances are differences of squares, as in tests/train/test_losses.py
LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-6, 1e-5


def images(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return (truth / 255 + 0.1 * noise).float(), truth


@pytest.mark.parametrize("size", [(23, 31), (1, 40), (3, 1)])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("masked", [False, True])
def test_loss_and_gradient_agree_with_float64(size, ssim_weight, masked):
    image, truth = images(*size)
    mask = None
    if masked:
        mask = torch.rand(size, generator=torch.Generator().manual_seed(1)) < 0.7
    exact = image.double().requires_grad_()
    value = photometric_loss(exact, truth.double() / 255, ssim_weight, mask=mask)
    value.backward()
    ours = image.to(DEVICE).requires_grad_()
    own = loss_module.photometric_loss(
        ours, truth.to(DEVICE), ssim_weight, mask=None if mask is None else mask.to(DEVICE))
    (3 * own).backward()
    assert own.item() == pytest.approx(value.item(), abs=LOSS_TOLERANCE)
    error = (ours.grad.double().cpu() / 3 - exact.grad).norm()
    assert error <= GRADIENT_TOLERANCE * exact.grad.norm()


def test_what_is_not_finite_does_no_harm_under_a_mask():
    image, truth = images(20, 20)
    mask = torch.ones(20, 20, dtype=torch.bool)
    mask[7, 9] = False
    image[7, 9] = torch.nan
    tracked = image.to(DEVICE).requires_grad_()
    loss = loss_module.photometric_loss(tracked, truth.to(DEVICE), 0.2, mask=mask.to(DEVICE))
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(tracked.grad).all()
    assert (tracked.grad[7, 9] == 0).all()


def test_a_training_step_leaves_the_gradients_that_torch_leaves():
    splats, camera = random_splats(30, seed=3).map(torch.Tensor.float), camera_at(24, 18)
    _, truth = images(18, 24)
    found = {}
    for backend, device in (("torch", "cpu"), ("triton", DEVICE)):
        optimizer = SplatOptimizer(
            splats.map(lambda tensor, device=device: tensor.clone().to(device)), CONFIG, 1.0)
        value, statistics = gradient_step(backend)(
            optimizer, TrainView(camera, truth.numpy()), 3, 0.2)
        assert statistics is not None
        found[backend] = value, {
            name: optimizer.gradient(name).cpu() for name in splats.parameters()}
    assert found["triton"][0] == pytest.approx(found["torch"][0], abs=LOSS_TOLERANCE)
    for name, gradient in found["torch"][1].items():
        error = (found["triton"][1][name] - gradient).norm()
        assert error <= 10 * GRADIENT_TOLERANCE * gradient.norm(), name
