import math

import numpy as np
import pytest
from media import texture

from recon_cli.capture.scan import MotionMeter

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


def test_the_way_does_not_depend_on_the_frame_rate():
    slow, fast = pan(81, 1), pan(81, 1)[::8]
    assert measured(slow).sum() == pytest.approx(80 / 320, rel=0.02)
    assert measured(fast).sum() == pytest.approx(80 / 320, rel=0.02)


def test_large_frames_count_alike():
    small = pan(10, 4)
    large = [np.kron(frame, np.ones((3, 3), np.uint8)) for frame in small]
    assert measured(large).sum() == pytest.approx(measured(small).sum(), rel=0.02)


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
