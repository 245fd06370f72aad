"""Which pictures show nothing that others show."""

import cv2
import numpy as np
import pytest

from recon_cli.capture.strangers import count_agreeing, find_features, find_strangers
from recon_cli.scene.matches import MIN_PAIR_INLIERS


def scene(seed, shift=0):
    """A view of a wall with blots, `shift` pixels to the right of the first one."""
    noise = np.random.default_rng(seed).normal(0, 1, (240, 800))
    blots = cv2.GaussianBlur(noise, None, 3.0)
    return np.clip(128 + 70 * blots / blots.std(), 0, 255).astype(np.uint8)[:, shift:shift + 320]


@pytest.mark.parametrize("change", [
    lambda gray: gray, lambda gray: cv2.resize(gray, (480, 360)),
    lambda gray: (0.5 * gray + 20).astype(np.uint8)])
def test_views_of_one_scene_agree_and_those_of_two_do_not(change):
    first = find_features(scene(0))
    assert count_agreeing(first, find_features(change(scene(0, shift=100)))) >= 2 * MIN_PAIR_INLIERS
    assert count_agreeing(first, find_features(change(scene(1)))) < MIN_PAIR_INLIERS


def test_plain_pictures_agree_with_none():
    plain = find_features(np.full((240, 320), 99, np.uint8))
    assert count_agreeing(plain, plain) == 0


@pytest.mark.integration
def test_only_what_no_other_shows_is_a_stranger_and_what_cannot_be_read_is_none():
    pictures = {0: scene(0), 1: scene(0, shift=60), 2: scene(1), 3: scene(0, shift=120), 4: None}
    assert find_strangers([2, 3, 4], [0, 1], pictures.get) == [2]
