"""Corners that are followed through the frames of a video."""

import cv2
import numpy as np
import pytest
from media import texture

from recon_cli.capture.limits import TRACK_SIZE
from recon_cli.capture.tracker import CELL, Tracker, find_corners

pytestmark = pytest.mark.floors

STEP = 3  # pixels a frame
WIDE = texture(240, 640, coarseness=6)[:, :, 0]


def view(index):
    return np.ascontiguousarray(WIDE[:, index * STEP:index * STEP + 320])


def follow(frames):
    tracker = Tracker()
    for gray in frames:
        tracker.advance(gray)
    return tracker.tracks()


def moved(tracks, first, second, size=(320, 240)):
    ours, theirs = tracks.matches(first, second)
    return (tracks.xy[theirs] - tracks.xy[ours]) * np.array(size)


def test_corners_move_as_the_view_does():
    tracks = follow(map(view, range(20)))
    steps = moved(tracks, 0, 10)
    assert len(steps) > 50
    np.testing.assert_allclose(np.median(steps, axis=0), [-30, 0], atol=0.05)
    assert (np.abs(steps - [-30, 0]).max(axis=1) < 1).mean() > 0.95


def test_an_observation_is_a_share_of_the_frame_from_its_outer_corner():
    gray = np.full((120, 200), 60, np.uint8)
    gray[50:, 70:] = 200  # the corner between pixels lies at (70, 50)
    tracks = follow([gray])
    corner = tracks.xy[np.abs(tracks.xy - [70 / 200, 50 / 120]).max(axis=1).argmin()]
    np.testing.assert_allclose(corner * [200, 120], [70, 50], atol=3)


def test_a_change_of_exposure_breaks_no_track():
    darker = [np.clip(view(i) * (1 - 0.035 * i) + 5, 0, 255).astype(np.uint8) for i in range(15)]
    assert len(moved(follow(darker), 0, 14)) > 0.7 * len(moved(follow(map(view, range(15))), 0, 14))


def test_what_is_hidden_is_lost_and_its_place_gets_new_corners():
    covered = [view(i).copy() for i in range(10)]
    for gray in covered[5:]:
        gray[:, :160] = 128
    tracks = follow(covered)
    ours, _ = tracks.matches(4, 5)
    assert (tracks.xy[ours, 0] > 0.48).all()  # a window reaches beyond its corner
    fresh = follow([*covered, *map(view, range(9, 14))])
    new = fresh.track[fresh.image == 14] > fresh.track[fresh.image == 9].max()
    assert (fresh.xy[fresh.image == 14][new, 0] < 0.6).sum() > 20


def test_a_cut_to_another_place_ends_nearly_all_tracks():
    other = texture(240, 320, coarseness=6, seed=5)[:, :, 0]
    tracks = follow([view(0), view(1), other, other])
    assert len(tracks.matches(0, 1)[0]) > 100
    assert len(tracks.matches(1, 2)[0]) < 15
    assert len(tracks.matches(2, 3)[0]) > 100


def test_each_cell_of_a_frame_holds_its_best_corner():
    gray = np.full((200, 300), 100, np.uint8)
    squares = [(50, 50), (50, 210), (150, 130)]
    for y, x in squares:
        gray[y - 4:y + 5, x - 4:x + 5] = 220
    corners = find_corners(gray)
    assert all(np.abs(corners - [x, y]).max(axis=1).min() < 8 for y, x in squares)
    assert all(min(np.abs([cy - y, cx - x]).max() for y, x in squares) < 12 for cx, cy in corners)
    assert len(np.unique(corners // CELL, axis=0)) == len(corners)
    assert len(find_corners(np.full((200, 300), 100, np.uint8))) == 0


@pytest.mark.parametrize("scale", [1, 4])
def test_a_large_frame_is_followed_at_a_reduced_size(scale):
    frames = [cv2.resize(view(i), None, fx=scale, fy=scale) for i in range(6)]
    assert (max(frames[0].shape) > TRACK_SIZE) == (scale == 4)
    steps = moved(follow(frames), 0, 5, (320 * scale, 240 * scale))
    np.testing.assert_allclose(np.median(steps, axis=0), [-15 * scale, 0], atol=0.1 * scale)


def test_a_second_pass_gives_the_same_tracks():
    first, second = (follow(map(view, range(12))) for _ in range(2))
    np.testing.assert_array_equal(first.xy, second.xy)
    np.testing.assert_array_equal(first.track, second.track)


def test_a_video_without_any_texture_has_no_tracks():
    assert len(follow([np.full((240, 320), 90, np.uint8)] * 3).image) == 0
