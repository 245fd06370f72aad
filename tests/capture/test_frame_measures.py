"""Exposure, sharpness and motion of frames."""

import math

import numpy as np
import pytest
from facts import raises
from media import texture

from recon_cli.capture.frame_measures import (
    MotionMeter,
    check_exposure,
    has_content,
    measure_exposure,
    well_exposed,
)
from recon_cli.errors import InputError


def gray(seed=0):
    return texture(96, 160, seed=seed)[:, :, 0]


def rows(*frames):
    return np.array([measure_exposure(frame) for frame in frames])


def half_dark(share):
    frame = gray()
    frame[:int(share * 96)] = 2
    return frame


def test_the_shares_of_black_and_blown_out_pixels_are_what_they_are():
    frame = np.full((80, 160), 128, np.uint8)
    frame[:, :40], frame[:, 40:60] = 0, 255
    black, blown, spread = measure_exposure(frame)
    assert (black, blown) == (0.25, 0.125)
    assert spread == pytest.approx(frame.std(), rel=0.01)


def test_noise_on_a_flat_wall_is_no_spread():
    noise = np.random.default_rng(0).normal(128, 20, (480, 640)).clip(0, 255).astype(np.uint8)
    assert measure_exposure(noise)[2] < 2


def test_frames_that_are_clipped_for_the_most_part_are_not_well_exposed():
    found = rows(gray(), half_dark(0.4), half_dark(0.6), np.full((96, 160), 255, np.uint8))
    assert well_exposed(found).tolist() == [True, True, False, False]
    assert has_content(found).tolist() == [True, True, True, False]


@pytest.mark.parametrize(("value", "fault"), [(3, "dark"), (255, "over-exposed"), (128, "flat")])
def test_a_capture_that_shows_nothing_is_refused_with_what_is_wrong(value, fault):
    frames = rows(*[np.full((96, 160), value, np.uint8)] * 20)
    with raises(InputError, "room.mp4", fault, 20, 3):
        check_exposure("room.mp4", frames, least=3)


def test_a_few_frames_that_show_something_are_enough():
    black = np.zeros((96, 160), np.uint8)
    check_exposure("room.mp4", rows(*[black] * 20, gray(1), gray(2), gray(3)), least=3)


def test_a_capture_that_is_dark_here_and_blown_out_there_is_refused_too():
    frames = rows(*[np.full((96, 160), value, np.uint8) for value in (2, 255) * 5])
    with raises(InputError, 10, "frames"):
        check_exposure("room.mp4", frames, least=3)


# Lucas-Kanade finds whole-pixel shifts of a sharp texture to a twentieth of a pixel.
TOLERANCE = 0.05 / 320


def measured(frames):
    meter = MotionMeter()
    return np.array([meter.advance(frame) for frame in frames])


def pan(frames, step, width=320):
    wide = texture(180, width + frames * step)[:, :, 0]
    return [np.ascontiguousarray(wide[:, i * step:i * step + width]) for i in range(frames)]


def test_a_shift_is_its_share_of_the_width():
    steps = measured(pan(20, 4))
    assert steps[0] == 0
    np.testing.assert_allclose(steps[1:], 4 / 320, atol=TOLERANCE)


@pytest.mark.integration
def test_the_way_does_not_depend_on_the_frame_rate():
    slow, fast = pan(81, 1), pan(81, 1)[::8]
    assert measured(slow).sum() == pytest.approx(80 / 320, rel=0.02)
    assert measured(fast).sum() == pytest.approx(80 / 320, rel=0.02)


def test_large_frames_count_alike():
    small = pan(10, 4)
    large = [np.kron(frame, np.ones((3, 3), np.uint8)) for frame in small]
    assert measured(large).sum() == pytest.approx(measured(small).sum(), rel=0.02)


@pytest.mark.integration
def test_a_camera_on_a_tripod_does_not_creep_through_noise():
    still = texture(180, 320)[:, :, 0].astype(float)
    noise = np.random.default_rng(0)
    frames = [
        np.clip(still + noise.normal(0, 6, still.shape), 0, 255).astype(np.uint8)
        for _ in range(60)
    ]
    assert measured(frames).sum() < 0.001


def test_shaking_on_the_spot_counts_once():
    frames = pan(5, 1)
    assert measured(frames + frames[::-1] + frames).sum() == pytest.approx(4 / 320, rel=0.05)


def test_a_blank_wall_leaves_motion_unknown():
    blank = np.full((180, 320), 128, np.uint8)
    steps = measured([blank] * 3)
    assert steps[0] == 0
    assert all(math.isnan(step) for step in steps[1:])


def test_tracking_starts_again_behind_a_blank_wall():
    blank = np.full((180, 320), 128, np.uint8)
    steps = measured([*pan(3, 4), blank, *pan(3, 4)])
    assert np.isnan(steps[3:5]).all()
    np.testing.assert_allclose(steps[5:], 4 / 320, atol=TOLERANCE)


def test_the_share_of_followed_corners_tells_a_step_from_another_place():
    wide = texture(96, 200, coarseness=12)[:, :, 0]
    other = texture(96, 128, seed=5, coarseness=12)[:, :, 0]
    shares = []
    for after in (wide[:, 2:130], other):
        meter = MotionMeter()
        meter.advance(wide[:, :128])
        meter.advance(after)
        shares.append(meter.followed)
    assert shares[0] > 0.9
    assert shares[1] < 0.3
