import pytest
from facts import assert_facts, raises

from recon_cli.errors import SfmError
from recon_cli.sfm.mapping import checks

NAMES = [f"{index:06d}.png" for index in range(20)]


def test_three_textured_frames_are_enough_to_go_on():
    checks.check_texture({"a": 15, "b": 500, "c": 20, "d": 0})


def test_bare_frames_are_counted_in_the_message():
    with raises(SfmError, 2, 4, "texture"):
        checks.check_texture({"a": 15, "b": 500, "c": 14, "d": 0})


def test_frames_that_share_nothing_are_refused():
    with raises(SfmError, "frames", "match"):
        checks.check_motion(0, 0, 0)


def test_matches_that_a_turn_explains_are_refused_and_half_of_them_are_not():
    checks.check_motion(50, 1000, 500)
    with raises(SfmError, "99%") as caught:
        checks.check_motion(50, 1000, 990)
    assert "sideways" in caught.value.hint


def test_as_many_frames_as_asked_for_are_enough():
    checks.check_registered(NAMES, NAMES[:10], 0.5)


def test_too_few_frames_are_counted_and_the_first_missing_are_named():
    with pytest.raises(SfmError) as caught:
        checks.check_registered(NAMES, NAMES[:9], 0.5)
    assert_facts(caught.value.message, 9, 20, 10, "frames")
    assert "000009.png, 000010.png" in caught.value.message
    assert_facts(caught.value.message, 6)
    assert "--min-registered" in caught.value.hint


def test_two_frames_are_never_enough():
    with raises(SfmError, 3):
        checks.check_registered(NAMES, NAMES[:2], 0.0)


def test_points_seen_from_one_place_are_refused():
    checks.check_parallax(3.9)
    with raises(SfmError, "1.6"):
        checks.check_parallax(1.6)
