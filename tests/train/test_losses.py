"""The loss against scikit-image, its own definition, and autograd."""

import numpy as np
import pytest
import torch
from facts import raises
from skimage.metrics import structural_similarity

from recon_cli.kernels.thread_pool import pool
from recon_cli.render.numba.loss import MAPS, MIN_WIDTH, photometric
from recon_cli.train.fit.gradient import blur, photometric_loss

# The fused loss computes in float32. Measured 5e-7, and 3e-6 for the gradient.
LOSS_TOLERANCE = 1e-6
GRADIENT_TOLERANCE = 1e-5
# Variances are differences of squares: they are off by some 2^-22 where C2 = 9e-4 is all that
# they are compared with, as in a part of the image where nothing varies. Measured 7e-5.
FLAT_TOLERANCE = 2.0**-22 / 9e-4


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


def test_the_gradient_under_a_mask_is_zero_and_exact_elsewhere():
    image, truth = images()
    mask = torch.ones(24, 31, dtype=torch.bool)
    mask[5:12, 8:20] = False
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, truth, 0.5, mask=mask), (image,), eps=1e-6, atol=1e-7,
        fast_mode=True)
    photometric_loss(image, truth, 0.5, mask=mask).backward()
    assert not image.grad[~mask].any()
    assert image.grad[mask].all()


def test_a_masked_pixel_counts_as_one_without_error():
    image, truth = images()
    mask = torch.zeros(24, 31, dtype=torch.bool)
    mask[3, 4] = True
    error = (image - truth).abs()[3, 4].sum().item()
    assert photometric_loss(image, truth, 0.0, mask=mask).item() == pytest.approx(
        error / truth.numel(), rel=1e-12)


def test_a_value_that_is_not_finite_does_no_harm_under_a_mask():
    image, truth = images()
    mask = torch.ones(24, 31, dtype=torch.bool)
    mask[10, 10] = False
    with torch.no_grad():
        image[10, 10] = torch.nan
    loss = photometric_loss(image, truth, 0.2, mask=mask)
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(image.grad).all()


# ---- the fused loss of the numba backend ----

# height, width; 86 and 171 end just behind a block of columns, 88 and 173 within its reach
SIZES = [(360, 640), (37, 50), (11, 6), (1, 40), (1, 6), (7, 300), (4, 86), (9, 88), (20, 171),
         (5, 173)]
WEIGHTS = [0.0, 0.2, 1.0]


def fused(image, truth, ssim_weight):
    """The loss and its gradient by the kernels."""
    height, width = truth.shape[:2]
    gradient = np.full(image.size, np.nan, np.float32)
    loss = photometric(
        image.reshape(-1), truth.reshape(-1).copy(), width, height, ssim_weight,
        maps=np.full(MAPS * image.size, np.nan, np.float32), gradient=gradient)
    return loss, gradient.reshape(image.shape)


def exact(image, truth, ssim_weight):
    """The same in float64, by the closed form that is tested above."""
    leaf = torch.from_numpy(image).double().requires_grad_()
    loss = photometric_loss(leaf, torch.from_numpy(truth).double() / 255, ssim_weight)
    loss.backward()
    return loss.item(), leaf.grad.numpy()


def bytes_and_render(height, width, seed=0):
    """Random bytes, and a picture that differs from them by more than rounding everywhere."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    apart = rng.uniform(0.01, 0.2, truth.shape) * rng.choice([-1, 1], truth.shape)
    return (truth / 255 + apart).astype(np.float32), truth


def relative(ours, theirs):
    return np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)


@pytest.mark.integration
@pytest.mark.parametrize("ssim_weight", WEIGHTS)
@pytest.mark.parametrize("size", SIZES)
def test_the_fused_loss_and_gradient_equal_the_closed_form(size, ssim_weight):
    image, truth = bytes_and_render(*size)
    loss, gradient = fused(image, truth, ssim_weight)
    true_loss, true_gradient = exact(image, truth, ssim_weight)
    assert loss == pytest.approx(true_loss, abs=LOSS_TOLERANCE)
    assert relative(gradient, true_gradient) < GRADIENT_TOLERANCE


def test_a_perfect_picture_has_no_fused_loss_and_next_to_no_gradient():
    _, truth = bytes_and_render(37, 50)
    image = truth * np.float32(1 / 255)
    assert fused(image, truth, 0.0)[0] == 0
    assert not fused(image, truth, 0.0)[1].any()
    for ssim_weight in (0.2, 1.0):
        loss, gradient = fused(image, truth, ssim_weight)
        assert loss == pytest.approx(0, abs=LOSS_TOLERANCE)
        # a picture that is off has gradients of about 1 / size
        assert np.abs(gradient).max() * gradient.size < GRADIENT_TOLERANCE


@pytest.mark.parametrize("shade", [0, 128, 255])
@pytest.mark.parametrize("true_shade", [0, 128, 255])
def test_constant_pictures_have_the_ssim_of_their_means(shade, true_shade):
    truth = np.full((37, 50, 3), true_shade, np.uint8)
    image = np.full(truth.shape, shade / 255, np.float32)
    for ssim_weight in WEIGHTS:
        loss, gradient = fused(image, truth, ssim_weight)
        true_loss, true_gradient = exact(image, truth, ssim_weight)
        assert loss == pytest.approx(true_loss, abs=FLAT_TOLERANCE)
        off = np.abs(gradient - true_gradient)
        if shade == true_shade:  # |x - y| has no slope at 0: rounding decides on its sign
            off -= (1 - ssim_weight) / truth.size
        assert off.max() * truth.size < 4 * FLAT_TOLERANCE


def test_fused_ssim_of_constants_away_from_the_border_is_the_closed_form():
    a, b = 128 / 255, 64 / 255
    truth = np.full((11, 11, 3), 64, np.uint8)
    image = np.full(truth.shape, a, np.float32)
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    within = np.convolve(np.ones(11), window / window.sum(), "same")
    share = np.outer(within, within)  # of the window that lies inside the image
    mean_a, mean_b = share * a, share * b
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    spread = share - share**2  # zeros beyond the border vary the picture
    contrast = (2 * a * b * spread + 9e-4) / ((a * a + b * b) * spread + 9e-4)
    assert share[5, 5] == pytest.approx(1, abs=1e-12)
    assert (luminance * contrast)[5, 5] == pytest.approx(
        (2 * a * b + 1e-4) / (a * a + b * b + 1e-4), rel=1e-9)
    assert 1 - fused(image, truth, 1.0)[0] == pytest.approx(
        (luminance * contrast).mean(), abs=FLAT_TOLERANCE)


@pytest.mark.parametrize("size", [(37, 50), (3, 300)])
def test_any_number_of_threads_gives_the_same_bits_of_the_loss(size, monkeypatch):
    image, truth = bytes_and_render(*size)
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(pool, "threads", threads)
        loss, gradient = fused(image, truth, 0.2)
        found.append((loss, gradient.tobytes()))
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("ssim_weight", WEIGHTS)
def test_values_far_outside_the_range_of_images_keep_their_loss(ssim_weight):
    image, truth = bytes_and_render(20, 30)
    image[4, 7], image[11, 2] = 500, -500
    loss, gradient = fused(image, truth, ssim_weight)
    true_loss, true_gradient = exact(image, truth, ssim_weight)
    assert loss == pytest.approx(true_loss, rel=GRADIENT_TOLERANCE)
    assert np.isfinite(gradient).all()
    assert relative(gradient, true_gradient) < FLAT_TOLERANCE


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("ssim_weight", WEIGHTS)
@pytest.mark.parametrize("pixel", [(0, 0), (19, 29), (7, 13)])
def test_one_pixel_that_is_not_finite_shows_in_the_fused_loss(pixel, ssim_weight, value):
    image, truth = bytes_and_render(20, 30)
    image[pixel][1] = value
    assert not np.isfinite(fused(image, truth, ssim_weight)[0])


def test_images_that_do_not_fill_a_vector_are_refused():
    for width in (1, MIN_WIDTH - 1):
        with raises(ValueError, width, MIN_WIDTH):
            fused(*bytes_and_render(20, width), 0.2)
    assert np.isfinite(fused(*bytes_and_render(20, MIN_WIDTH), 0.2)[0])


def test_arrays_of_another_size_are_refused():
    image, truth = bytes_and_render(20, 30)
    with raises(ValueError, "30x20"):
        fused(image[:-1], truth, 0.2)
