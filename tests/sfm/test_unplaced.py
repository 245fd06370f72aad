from types import SimpleNamespace

import numpy as np

from recon_cli.sfm.outlier_cameras import reasons


def capture(keypoints, pairs=(), matches=()):
    """Images of which the first two have a camera."""
    count = len(keypoints)
    return SimpleNamespace(
        names=tuple("abcd"[:count]), registered=np.arange(count) < 2,
        keypoints=np.array(keypoints), pairs=np.array(pairs, np.int64).reshape(-1, 2),
        matches=np.array(matches, np.int64))


def test_the_sharpness_of_the_others_decides_what_is_blurred():
    evidence = capture([900, 900, 900])
    assert reasons(evidence, {"a": 50.0, "b": 60.0, "c": 20.0}) == {
        "c": "blurred: sharpness 20, 50 is usual"}
    assert "no overlap" in reasons(evidence, {"a": 50.0, "b": 60.0, "c": 40.0})["c"]


def test_an_image_that_matches_another_room_is_not_called_blurred_alone():
    evidence = capture([900] * 4, [[0, 1], [2, 3]], [300, 300])
    assert reasons(evidence, {"a": 50.0, "b": 60.0, "c": 20.0, "d": 61.0})["c"] == (
        "no overlap: no verified match with an image that has a camera, only with 1 that have "
        "none; sharpness 20, 55 is usual")


def test_an_image_of_a_bare_wall_has_too_few_features():
    assert reasons(capture([900, 900, 40]), {}) == {"c": "too few features: 40 keypoints"}


def test_an_image_that_matches_nothing_has_no_overlap():
    assert reasons(capture([900] * 3, [[0, 1]], [300]), {"c": None}) == {
        "c": "no overlap: no verified match with an image that has a camera"}


def test_an_image_that_matches_is_said_to_match():
    found = reasons(capture([900] * 3, [[0, 1], [0, 2], [1, 2]], [300, 20, 30]), {})
    assert found == {"c": "matched but not placed: 50 matches to 2 images that have a camera"}
