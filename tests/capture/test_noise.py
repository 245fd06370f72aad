import cv2
import numpy as np
import pytest

from recon_cli.capture.noise import denoised, estimate_noise
from recon_cli.config import DenoiseConfig

STRENGTH = DenoiseConfig().strength


def plain_room():
    """Smooth shading with a few edges and a textured corner, [180, 240, 3]."""
    y, x = np.mgrid[:180, :240]
    room = np.stack([90 + 0.3 * x, 110 + 0.2 * y, 140 - 0.1 * x - 0.1 * y], axis=-1)
    room[100:, 60:130] = (60, 90, 160)
    blocks = np.random.default_rng(3).integers(40, 200, (20, 30, 3))
    room[:60, :90] = np.kron(blocks, np.ones((3, 3, 1)))
    return np.round(room).astype(np.uint8)


def psnr(rgb, truth):
    return 10 * np.log10(255**2 / np.mean((rgb.astype(float) - truth) ** 2))


def noisy(rgb, sigma, seed=0):
    noise = np.random.default_rng(seed).normal(0, sigma, rgb.shape)
    return np.clip(np.round(rgb + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [3, 5, 10, 15, 25])
def test_added_noise_is_estimated(sigma):
    # The low percentile of 64 estimates lies a few percent under their mean.
    assert estimate_noise(noisy(plain_room(), sigma)) == pytest.approx(sigma, rel=0.15)


def test_texture_is_not_taken_for_noise():
    assert estimate_noise(plain_room()) < 1


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (128, 128, 128), (200, 0, 0)])
def test_a_flat_frame_has_no_noise(colour, recwarn):
    flat = np.full((64, 96, 3), colour, np.uint8)
    assert estimate_noise(flat) == pytest.approx(0, abs=1e-9)
    assert not recwarn.list


def test_clipped_windows_do_not_hide_the_noise():
    room = plain_room()
    room[:, 120:] = 255
    assert estimate_noise(noisy(room, 10)) == pytest.approx(10, rel=0.15)


def test_small_frames_can_be_measured():
    assert estimate_noise(noisy(np.full((16, 20, 3), 128, np.uint8), 10)) == pytest.approx(
        10, rel=0.3)


@pytest.mark.parametrize(("sigma", "gain"), [(5, 3), (15, 6), (25, 7)])
def test_denoising_brings_a_frame_closer_to_the_truth(sigma, gain):
    truth = plain_room()
    spoiled = noisy(truth, sigma)
    better = denoised(spoiled, STRENGTH * estimate_noise(spoiled))
    assert psnr(better, truth) > psnr(spoiled, truth) + gain


def test_an_edge_stays_where_and_as_high_as_it_was():
    step = np.full((60, 80, 3), 60, np.uint8)
    step[:, 40:] = 190
    better = denoised(noisy(step, 10), STRENGTH * 10).astype(float)
    columns = better.mean(axis=(0, 2))
    # 130 high, noise of 10: the columns beside the edge keep their side within the noise's mean.
    np.testing.assert_allclose(columns[36:40], 60, atol=6)
    np.testing.assert_allclose(columns[40:44], 190, atol=6)


def test_without_noise_nothing_is_filtered_away():
    room = plain_room()
    shift = cv2.absdiff(denoised(room, STRENGTH * 0.3), room)
    assert shift.max() <= 2
