"""The estimate of noise and the filter that removes it."""

import cv2
import numpy as np
import pytest
from noisy_room import noisy, plain_room, psnr

from recon_cli.capture.noise import bilateral, estimate_noise
from recon_cli.config.stages import DenoiseConfig

pytestmark = pytest.mark.floors


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


STRENGTH = DenoiseConfig().strength


@pytest.mark.parametrize(("sigma", "gain"), [(5, 3), (15, 6), (25, 7)])
def test_denoising_brings_a_frame_closer_to_the_truth(sigma, gain):
    truth = plain_room()
    spoiled = noisy(truth, sigma)
    better = bilateral(spoiled, estimate_noise(spoiled), STRENGTH)
    assert psnr(better, truth) > psnr(spoiled, truth) + gain


def test_an_edge_stays_where_and_as_high_as_it_was():
    step = np.full((60, 80, 3), 60, np.uint8)
    step[:, 40:] = 190
    columns = bilateral(noisy(step, 10), 10, STRENGTH).astype(float).mean(axis=(0, 2))
    # 130 high, noise of 10: the columns beside the edge keep their side within the noise's mean.
    np.testing.assert_allclose(columns[36:40], 60, atol=6)
    np.testing.assert_allclose(columns[40:44], 190, atol=6)


def test_without_noise_nothing_is_filtered_away():
    room = plain_room()
    assert cv2.absdiff(bilateral(room, 0.3, STRENGTH), room).max() <= 2


def test_the_number_of_threads_changes_no_pixel():
    spoiled = noisy(plain_room(), 10)
    before = cv2.getNumThreads()
    try:
        results = []
        for threads in (1, 4):
            cv2.setNumThreads(threads)
            results.append(bilateral(spoiled, 10, STRENGTH))
    finally:
        cv2.setNumThreads(before)
    np.testing.assert_array_equal(*results)


def test_a_frame_of_a_few_pixels_can_be_filtered():
    assert bilateral(np.full((3, 2, 3), 90, np.uint8), 5, STRENGTH).tolist() == [
        [[90] * 3] * 2] * 3


@pytest.mark.integration
def test_a_large_frame_is_measured_by_the_middle_of_its_tiles():
    generator = np.random.default_rng(0)
    frame = np.clip(np.rint(generator.normal(120, 6, (1600, 2000, 3))), 0, 255).astype(np.uint8)
    measured = estimate_noise(frame)
    assert measured == pytest.approx(6, rel=0.05)
    outside = frame.copy()
    outside[:40], outside[-40:], outside[:, :50], outside[:, -50:] = 0, 255, 0, 255
    assert estimate_noise(outside) == measured
