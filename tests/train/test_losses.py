"""The loss against scikit-image, its own definition, and autograd."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from recon_cli.train.losses import blur, photometric_loss


def images(height=24, width=31, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return (truth + 0.1 * noise).requires_grad_(), truth


def test_equal_images_have_no_loss_and_no_gradient():
    _, truth = images()
    image = truth.clone().requires_grad_()
    loss = photometric_loss(image, truth, 1.0)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-12)
    assert image.grad.abs().max() < 1e-10


def test_without_ssim_the_loss_is_the_mean_absolute_error():
    image, truth = images()
    assert photometric_loss(image, truth, 0.0).item() == pytest.approx(
        (image - truth).abs().mean().item(), rel=1e-12)


def test_ssim_equals_scikit_image_away_from_the_border():
    image, truth = images(40, 40)
    _, theirs = structural_similarity(
        image.detach().numpy(), truth.numpy(), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, channel_axis=-1, full=True)
    # replicate the padding question away: embed in a frame so that the border never matters
    inner = theirs[10:-10, 10:-10].mean()
    image_in, truth_in = (x.detach().permute(2, 0, 1) for x in (image, truth))
    mu_x, mu_y, xx, yy, xy = blur(torch.stack(
        [image_in, truth_in, image_in**2, truth_in**2, image_in * truth_in]))
    ssim = ((2 * mu_x * mu_y + 1e-4) * (2 * (xy - mu_x * mu_y) + 9e-4)
            / ((mu_x**2 + mu_y**2 + 1e-4) * (xx - mu_x**2 + yy - mu_y**2 + 9e-4)))
    assert ssim[:, 10:-10, 10:-10].mean().item() == pytest.approx(inner, abs=1e-9)
    assert 1 - photometric_loss(image, truth, 1.0).item() == pytest.approx(
        ssim.mean().item(), abs=1e-12)


@pytest.mark.parametrize("size", [(24, 31), (3, 40), (1, 1)])
def test_the_closed_form_gradient_agrees_with_central_differences(size):
    image, truth = images(*size)
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, truth, 1.0), (image,), eps=1e-6, atol=1e-7, fast_mode=True)


def test_blur_keeps_a_constant_and_spreads_an_impulse_by_the_window():
    constant = blur(torch.ones(1, 30, 30, dtype=torch.float64))
    assert constant[0, 15, 15].item() == pytest.approx(1, abs=1e-12)
    impulse = torch.zeros(1, 21, 21, dtype=torch.float64)
    impulse[0, 10, 10] = 1
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window /= window.sum()
    assert np.allclose(blur(impulse)[0, 5:16, 5:16].numpy(), np.outer(window, window), atol=1e-15)
