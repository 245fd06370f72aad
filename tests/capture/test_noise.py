import numpy as np
import pytest
from noisy_room import noisy, plain_room

from recon_cli.capture.noise import estimate_noise


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
