"""Keyframes of a long video: as many as its tracks need, the first and the last among them."""

import numpy as np
import pytest

from recon_cli.io.tracks import Tracks
from recon_cli.sfm.features import keyframes


def steady(count, life):
    """A video in which each of 100 tracks lasts `life` frames, and another takes its place."""
    image, track = [], []
    for index in range(count):
        for slot in range(100):
            image.append(index)
            track.append(slot + 100 * ((index + slot * life // 100) // life))
    order = np.lexsort((track, image))
    return Tracks(tuple(f"{index:06d}.png" for index in range(count)),
                  np.array(image, np.int32)[order], np.array(track, np.int32)[order],
                  np.zeros((len(image), 2), np.float32))


def test_a_short_video_has_keyframes_alone():
    assert keyframes.choose_keyframes(steady(30, 4)) == tuple(range(30))
    assert keyframes.side_pairs(steady(30, 4)) == set()


@pytest.mark.parametrize(("life", "step"), [(10, 4), (5, 2), (2, 1), (200, keyframes.LONGEST)])
def test_keyframes_follow_the_length_of_tracks(monkeypatch, life, step):
    monkeypatch.setattr(keyframes, "FEW_FRAMES", 20)
    rows = keyframes.choose_keyframes(steady(41, life))
    assert rows[0] == 0
    assert rows[-1] == 40
    assert set(np.diff(rows[:-1])) == {step}


def test_frames_between_are_tied_to_the_keyframes_beside_them():
    rows = (0, 3, 4, 6)
    assert set(keyframes.track_rows(rows, (1, 2))) == {
        (0, 3), (3, 4), (4, 6), (0, 4), (3, 6),  # keyframes
        (0, 1), (1, 3), (0, 2), (2, 3), (4, 5), (5, 6)}


def test_frames_are_worth_matching_while_tracks_tie_them():
    tracks = steady(30, 10)
    first, near, far = (tracks.names[row] for row in (0, 5, 12))
    assert keyframes.share_tracks(tracks, {(first, near), (first, far)}) == {(first, near)}
