"""Repeated pictures of a video are found, however they are coded, and slow cameras are not."""

import cv2
import numpy as np
import pytest
from media import texture, write_video

from recon_cli.capture.repeats import find_stills, measure_shift, pick_representatives
from recon_cli.capture.scan import scan_video

SIZE = (240, 160)  # smaller than the tracker's size: a pixel is 1 / 240 of the longer side


def pan(speed, count, *, noise=0.0):
    """A camera that moves by so many pixels a frame, over blurred blocks, with noise."""
    width, height = SIZE
    wide = cv2.GaussianBlur(texture(height, width + 200, coarseness=8), (0, 0), 1.5)
    size = (width + 200, height)
    rng = np.random.default_rng(0)
    frames = []
    for index in range(count):
        matrix = np.array([[1, 0, -speed * index], [0, 1, 0.0]])
        moved = cv2.warpAffine(wide, matrix, size, flags=cv2.INTER_CUBIC)[:, :width]
        grain = rng.normal(0, noise, moved.shape) if noise else 0
        frames.append(np.clip(moved + grain, 0, 255).astype(np.uint8))
    return frames


def stills_of(path):
    scan = scan_video(path, threads=1, step=lambda: None)
    return find_stills(scan.tracks, scan.width, scan.height)


def repeat(frames, pattern):
    """Each frame as often as the pattern says in turn, and the number of each."""
    times = np.resize(pattern, len(frames))
    numbers = np.repeat(np.arange(len(frames)), times)
    return [frames[number] for number in numbers], numbers


# 24 to 30, 24 to 60 and 30 to 60 frames a second; a screen recorded at 60 of what changes 10 times.
@pytest.mark.integration
@pytest.mark.parametrize("pattern", [[1, 1, 1, 2], [2, 3], [2], [6]])
@pytest.mark.parametrize(("codec", "options"), [
    ("libx264", {"crf": "18"}), ("libx264", {"crf": "26"}), ("mpeg4", {"qmin": "5", "qmax": "5"})])
def test_repeats_of_a_walk_are_found_in_any_codec(tmp_path, codec, options, pattern):
    frames, numbers = repeat(pan(2, 8, noise=2), pattern)
    path = write_video(tmp_path / "a.mp4", frames, codec=codec, options=options)
    np.testing.assert_array_equal(stills_of(path), numbers)


@pytest.mark.integration
@pytest.mark.parametrize("speed", [0.25, 0.5, 1])
def test_a_slow_camera_shows_a_new_picture_in_each_frame(tmp_path, speed):
    path = write_video(tmp_path / "a.mp4", pan(speed, 30, noise=2), options={"crf": "23"})
    np.testing.assert_array_equal(stills_of(path), np.arange(30))


@pytest.mark.integration
def test_a_camera_that_creeps_shows_a_new_picture_when_it_has_moved_on(tmp_path):
    path = write_video(tmp_path / "a.mp4", pan(0.03, 80), options={"crf": "18"})
    # .12 pixels of 240 are the least shift: every fifth frame at the latest.
    assert 14 <= stills_of(path)[-1] <= 27


@pytest.mark.integration
def test_a_camera_at_rest_shows_one_picture_for_as_long_as_it_rests(tmp_path):
    walk = pan(2, 20, noise=3)
    rest = [np.clip(walk[9] + np.random.default_rng(i).normal(0, 3, walk[9].shape), 0, 255)
            .astype(np.uint8) for i in range(100)]
    path = write_video(
        tmp_path / "a.mp4", [*walk[:10], *rest, *walk[10:]], options={"crf": "20"})
    stills = stills_of(path)
    assert len(set(stills[10:110])) == 1
    assert stills[-1] == 19


@pytest.mark.integration
def test_what_moves_before_a_camera_at_rest_makes_no_new_picture(tmp_path):
    still = pan(2, 1)[0]
    frames = [still.copy() for _ in range(20)]
    for index, frame in enumerate(frames):
        frame[60:90, 20 + 4 * index:50 + 4 * index] = texture(30, 30, seed=5)
    path = write_video(tmp_path / "a.mp4", frames)
    assert stills_of(path)[-1] == 0


@pytest.mark.integration
def test_something_fixed_to_the_camera_does_not_hide_that_it_moves(tmp_path):
    frames = pan(2, 20)
    for frame in frames:
        frame[:80] = texture(80, 240, seed=7)
    path = write_video(tmp_path / "a.mp4", frames)
    np.testing.assert_array_equal(stills_of(path), np.arange(20))


def test_a_cut_is_a_new_picture(tmp_path):
    frames = [texture(160, 240, seed=number, coarseness=8) for number in (0, 0, 1, 1, 1, 2)]
    path = write_video(tmp_path / "a.mp4", frames)
    np.testing.assert_array_equal(stills_of(path), [0, 0, 1, 1, 1, 2])


def test_frames_without_corners_are_not_known_to_be_equal(tmp_path):
    path = write_video(tmp_path / "a.mp4", [np.full((160, 240, 3), 90, np.uint8)] * 4)
    np.testing.assert_array_equal(stills_of(path), np.arange(4))


@pytest.mark.parametrize("moves", [
    lambda p: np.full_like(p, 0.003), lambda p: 0.01 * p, lambda p: p[:, ::-1] * (0.01, -0.01)])
def test_a_shift_is_what_corners_move_together(moves):
    """Sideways, forwards and a roll, under noise that is ten times the shift that counts."""
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.5, 0.5, (4000, 2))
    expected = np.sqrt((moves(start) ** 2).sum(axis=1).mean())
    noise = rng.normal(0, 0.003, start.shape)
    found = measure_shift(start, start + moves(start) + noise)
    assert found == pytest.approx(expected, rel=0.2)  # the tenth that moves most is left out
    assert measure_shift(start, start + noise) < 0.0003


def test_the_sharpest_usable_frame_stands_for_a_picture():
    stills = np.array([0, 0, 0, 1, 2, 2, 3, 3])
    sharpness = np.array([5.0, 9, 7, 1, 8, 6, 4, 4])
    usable = np.array([1, 0, 1, 1, 1, 1, 0, 0], bool)
    bridges = np.array([0, 0, 0, 0, 1, 0, 0, 0], bool)
    standing = pick_representatives(stills, sharpness, usable, bridges)
    assert standing.tolist() == [2, 2, 2, 3, 5, 5, 6, 7]
