"""The triton backend's loss against the definition in torch, in an interpreter or on a GPU."""

import pytest
import torch
from interpreter import DEVICE

from recon_cli.train.fit.gradient import photometric_loss

loss_module = pytest.importorskip("recon_cli.render.triton.loss", reason="triton is not installed")
# float32; variances are differences of squares, as in tests/train/test_losses.py
LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-6, 1e-5


def images(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return (truth / 255 + 0.1 * noise).float(), truth


@pytest.mark.parametrize("size", [(13, 23), (1, 40), (3, 1)])
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
    own, gradient = loss_module.loss_and_gradient(
        image.to(DEVICE), truth.to(DEVICE), ssim_weight,
        None if mask is None else mask.to(DEVICE, torch.uint8))
    assert own.item() == pytest.approx(value.item(), abs=LOSS_TOLERANCE)
    error = (gradient.double().cpu() - exact.grad).norm()
    assert error <= GRADIENT_TOLERANCE * exact.grad.norm()


def test_what_is_not_finite_does_no_harm_under_a_mask():
    image, truth = images(14, 16)
    mask = torch.ones(14, 16, dtype=torch.uint8)
    mask[7, 9] = 0
    image[7, 9] = torch.nan
    loss, gradient = loss_module.loss_and_gradient(
        image.to(DEVICE), truth.to(DEVICE), 0.2, mask.to(DEVICE))
    assert torch.isfinite(loss)
    assert torch.isfinite(gradient).all()
    assert (gradient[7, 9] == 0).all()
