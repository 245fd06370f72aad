"""Observations of tracks: selection, matches, files."""

import numpy as np
from facts import raises
from safetensors.numpy import save_file

from recon_cli.errors import FormatError
from recon_cli.io.tracks import Tracks, merge_tracks


def make_tracks(seen):
    """Tracks from the numbers seen in each image; the place of a track says which it is."""
    image = np.repeat(np.arange(len(seen)), [len(numbers) for numbers in seen])
    track = np.array([number for numbers in seen for number in numbers])
    xy = np.stack([image / 100, track / 100], axis=1).astype(np.float32)
    return Tracks(
        tuple(map(str, range(len(seen)))), image.astype(np.int32), track.astype(np.int32), xy)


SEEN = [[0, 1], [0, 1, 2], [1, 2, 3], [2, 3], [4]]


def test_a_selection_keeps_the_tracks_that_reach_two_of_its_images():
    chosen = make_tracks(SEEN).select({0: "a.png", 2: "c.png", 3: "d.png", 4: "e.png"})
    assert chosen.names == ("a.png", "c.png", "d.png", "e.png")
    # Track 1 is seen in a and c, tracks 2 and 3 in c and d; 0 and 4 once.
    assert chosen.image.tolist() == [0, 1, 1, 1, 2, 2]
    assert chosen.track.tolist() == [0, 0, 1, 2, 1, 2]
    seen = [[0, 1], [2, 1], [2, 2], [2, 3], [3, 2], [3, 3]]
    np.testing.assert_allclose(chosen.xy, np.array(seen) / 100)


def test_observations_in_an_area_are_left_out():
    area = np.zeros((40, 4), np.bool_)
    area[1, 0] = True  # .025 to .05 of the height: tracks 3 and 4
    tracks = make_tracks(SEEN).outside(area)
    assert tracks.names == make_tracks(SEEN).names
    assert list(zip(tracks.image.tolist(), tracks.track.tolist(), strict=True)) == [
        (0, 0), (0, 1), (1, 0), (1, 1), (1, 2), (2, 1), (2, 2), (3, 2)]


def test_matches_of_two_images_show_the_same_tracks():
    tracks = make_tracks(SEEN)
    first, second = tracks.matches(1, 2)
    assert tracks.track[first].tolist() == tracks.track[second].tolist() == [1, 2]
    assert set(tracks.image[first]) == {1}
    assert set(tracks.image[second]) == {2}
    assert [len(rows) for rows in tracks.matches(0, 4)] == [0, 0]


def test_tracks_of_several_videos_stay_apart():
    merged = merge_tracks([make_tracks(SEEN[:2]), make_tracks([[]]), make_tracks(SEEN[:2])])
    assert merged.image.tolist() == [0, 0, 1, 1, 1, 3, 3, 4, 4, 4]
    assert merged.track.tolist() == [0, 1, 0, 1, 2, 3, 4, 3, 4, 5]
    assert len(merged.matches(0, 3)[0]) == 0


def test_a_file_gives_what_was_written(tmp_path):
    tracks = make_tracks(SEEN).select({0: "ä.png", 1: "b.png"})
    tracks.write(tmp_path / "tracks.safetensors")
    again = Tracks.read(tmp_path / "tracks.safetensors")
    assert again.names == ("ä.png", "b.png")
    for name in ("image", "track", "xy"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))


def test_no_tracks_at_all_are_tracks_too(tmp_path):
    none = make_tracks([[], []]).select({0: "a.png", 1: "b.png"})
    none.write(tmp_path / "tracks.safetensors")
    assert len(Tracks.read(tmp_path / "tracks.safetensors").image) == 0


def test_a_damaged_file_is_named(tmp_path):
    path = tmp_path / "tracks.safetensors"
    path.write_bytes(b"no tracks")
    with raises(FormatError, "tracks"):
        Tracks.read(path)
    save_file({"image": np.zeros(1, np.int32)}, path)
    with raises(FormatError, "tracks"):
        Tracks.read(path)
