import json

import cv2
import numpy as np
import pytest
from facts import assert_facts, raises
from media import texture

from recon_cli.capture.frame_selection import (
    FRAME_SPACING,
    MAX_GAP,
    MIN_AUTOMATIC,
    Reason,
    automatic_count,
    bridge_gaps,
    check_motion,
    choose_frames,
    choose_photos,
    count_reasons,
    describe_dropped,
    judge_frames,
    path_length,
    sharp_frames,
    video_candidates,
    write_choice,
)
from recon_cli.capture.same_view import measure_photo
from recon_cli.errors import InputError

FINE, DARK, HALF_DARK = (0.0, 0.0, 40.0), (1.0, 0.0, 0.0), (0.7, 0.0, 20.0)


def everything(count):
    return np.ones(count, np.bool_)


def test_a_blurred_frame_among_sharp_ones_is_found():
    sharpness = np.full(100, 200.0)
    sharpness[[7, 50, 99]] = 90.0
    assert np.flatnonzero(~sharp_frames(sharpness, 0.5)).tolist() == [7, 50, 99]
    assert sharp_frames(sharpness, 0.4).all()


def test_a_bare_stretch_is_judged_by_its_own_frames():
    sharpness = np.r_[np.full(100, 500.0), np.full(100, 5.0)]
    sharp = sharp_frames(sharpness, 0.5)
    assert sharp[:100].all()
    assert sharp[125:].all()


@pytest.mark.parametrize("count", [1, 3, 40])
def test_a_flat_video_passes_the_gate(count):
    assert sharp_frames(np.zeros(count), 0.5).all()


def test_unknown_steps_count_as_the_usual_one():
    way = path_length(np.array([0.0, 0.02, np.nan, 0.02, 0.04]))
    np.testing.assert_allclose(way, [0, 0.02, 0.04, 0.06, 0.1])


@pytest.mark.parametrize("motion", [np.zeros(50), np.r_[0.0, np.full(49, np.nan)]])
def test_where_nothing_moves_the_choice_spreads_over_time(motion):
    way = path_length(motion)
    chosen = choose_frames(way, np.ones(50), everything(50), 10)
    assert len(chosen) == 10
    np.testing.assert_allclose(np.diff(chosen), 5, atol=2)


def test_one_wild_step_does_not_eat_the_budget():
    motion = np.full(100, 0.01)
    motion[50] = 30.0
    assert path_length(motion)[-1] < 1.2


def test_the_number_of_frames_follows_the_way_within_bounds():
    assert automatic_count(np.array([0.0, 50 * FRAME_SPACING]), most=100) == 50
    assert automatic_count(np.array([0.0, 500 * FRAME_SPACING]), most=100) == 100
    assert automatic_count(np.array([0.0, 0.0]), most=100) == MIN_AUTOMATIC
    assert automatic_count(np.array([0.0, 0.0]), most=5) == 5


def test_frames_are_spread_over_the_way_not_over_time():
    # The camera rests for half of the video, then moves evenly.
    way = path_length(np.r_[np.zeros(100), np.full(100, 0.01)])
    chosen = choose_frames(way, np.ones(200), everything(200), 20)
    assert len(chosen) == 20
    assert (chosen < 100).sum() <= 1
    np.testing.assert_allclose(np.diff(way[chosen]), 0.05, atol=0.02)


def test_the_sharpest_frame_near_each_place_is_taken():
    sharpness = np.ones(100)
    sharpness[4::10] = 2.0
    chosen = choose_frames(np.linspace(0, 1, 100), sharpness, everything(100), 10)
    assert chosen.tolist() == list(range(4, 100, 10))


def test_frames_that_are_not_usable_are_never_taken():
    usable = np.arange(100) % 3 == 0
    chosen = choose_frames(np.linspace(0, 1, 100), np.ones(100), usable, 20)
    assert usable[chosen].all()
    assert len(chosen) == 20


@pytest.mark.parametrize("count", [3, 17, 60, 99, 100, 101])
def test_as_many_frames_as_asked_for_come_out_whatever_the_motion(count):
    motion = np.random.default_rng(count).exponential(0.02, 100) ** 2
    chosen = choose_frames(path_length(motion), motion, everything(100), count)
    assert len(chosen) == min(count, 100)
    assert (np.diff(chosen) > 0).all()


def test_a_blurred_turn_is_bridged_by_its_least_blurred_frames():
    way = np.linspace(0, 2, 201)  # 0.01 a frame
    sharp, sharpness = everything(201), np.full(201, 100.0)
    sharp[80:120], sharpness[80:120] = False, 10.0  # 0.4 widths of blur
    sharpness[100] = 20.0
    usable = bridge_gaps(way, sharpness, sharp, everything(201))
    kept = np.flatnonzero(usable)
    assert usable[100]
    assert np.diff(way[kept]).max() <= MAX_GAP
    assert len(kept) - sharp.sum() <= 8  # not the whole turn


def test_a_gap_is_bridged_off_its_middle_where_frames_are_much_sharper():
    way = np.linspace(0, 2, 201)
    sharp, sharpness = everything(201), np.full(201, 100.0)
    sharp[80:120], sharpness[80:120] = False, 10.0
    sharpness[82] = 40.0  # a plain view: sharp, but under the mark of the others
    assert bridge_gaps(way, sharpness, sharp, everything(201))[82]
    sharpness[82] = 15.0
    assert not bridge_gaps(way, sharpness, sharp, everything(201))[82]


def test_short_gaps_and_damaged_frames_are_not_bridged():
    way = np.linspace(0, 2, 201)
    sharp, whole = everything(201), everything(201)
    sharp[10:15] = False
    whole[80:120] = False
    assert (bridge_gaps(way, np.ones(201), sharp, whole) == (sharp & whole)).all()


def test_a_bridge_is_taken_only_where_there_is_nothing_better():
    # 0.2 widths of blur: among 4 frames, 0.5 apart, it needs no bridge; among 40 it does.
    way, sharpness = np.linspace(0, 2, 201), np.full(201, 100.0)
    sharpness[80:100] = 10.0
    found = judge_frames(way, sharpness, np.array([FINE] * 201), everything(201), 0.5)
    assert found.bridges[80:100].any()
    for count, bridges in ((4, False), (40, True)):
        chosen = choose_frames(way, sharpness, found.usable, count, bridges=found.bridges)
        assert len(chosen) == count
        assert found.bridges[chosen].any() == bridges, count


def test_where_all_is_blurred_the_sharpest_is_taken_though_it_lies_off_the_middle():
    way, usable = np.linspace(0, 1, 100), everything(100)
    sharpness = np.full(100, 10.0)
    sharpness[1] = 40.0
    assert 1 in choose_frames(way, sharpness, usable, 10, bridges=usable)
    assert 1 not in choose_frames(way, sharpness, usable, 10, bridges=~usable)


def test_frames_that_are_refused_have_a_reason():
    sharpness, whole = np.full(40, 100.0), everything(40)
    sharpness[5], whole[20:22] = 10.0, False
    exposures = np.array([FINE] * 40)
    exposures[30], exposures[5] = HALF_DARK, HALF_DARK
    found = judge_frames(np.linspace(0, 0.4, 40), sharpness, exposures, whole, 0.5)
    refused = {index: one for index, one in enumerate(found.refused) if one}
    assert refused == {
        5: Reason.CLIPPED, 20: Reason.DAMAGED, 21: Reason.DAMAGED, 30: Reason.CLIPPED}
    assert np.flatnonzero(~found.usable).tolist() == [5, 20, 21, 30]


def test_a_dim_stretch_is_bridged_but_a_black_one_is_not():
    way = np.linspace(0, 2, 201)
    for row, bridges in ((HALF_DARK, True), (DARK, False)):
        exposures = np.array([FINE] * 201)
        exposures[80:120] = row
        found = judge_frames(way, np.full(201, 100.0), exposures, everything(201), 0.5)
        assert found.usable[80:120].any() == bridges
        assert found.usable[80:120].sum() <= 8


def test_a_camera_that_does_not_move_is_refused():
    with raises(InputError, "room.mp4", 50):
        check_motion("room.mp4", np.zeros(50))


def test_twelve_adjacent_frames_are_warned_of():
    warning = check_motion("room.mp4", np.full(12, 0.003))
    assert_facts(warning, "3.3%")


def test_a_walk_and_a_motion_that_cannot_be_told_pass_in_silence():
    assert check_motion("room.mp4", np.full(50, 0.01)) == ""
    assert check_motion("room.mp4", np.r_[0.0, np.full(49, np.nan)]) == ""


REFUSED = (None, None, Reason.BLURRED, None, Reason.DAMAGED, None)
WAY = np.array([0.0, 0.0, 0.05, 0.08, 0.1, 0.12])


def record():
    names = {0: "000000.png", 5: "000005.png"}
    return video_candidates("room.mp4", np.full(6, 7.123), REFUSED, WAY, names)


def test_every_frame_has_a_reason():
    assert [one.reason for one in record()] == [
        Reason.KEPT, Reason.DUPLICATE, Reason.BLURRED, Reason.CLOSE, Reason.DAMAGED, Reason.KEPT]


def test_a_frame_too_close_names_the_kept_one_nearest_to_it():
    assert [one.like for one in record()] == [None, 0, None, 5, None, None]


def test_only_kept_frames_have_a_name():
    assert [one.name for one in record()] == [
        "000000.png", None, None, None, None, "000005.png"]


def test_the_record_is_written_with_its_counts_and_what_the_words_mean(tmp_path):
    write_choice(tmp_path / "choice.json", record())
    found = json.loads((tmp_path / "choice.json").read_text())
    assert found["counts"] == count_reasons(record()) == {
        "kept": 2, "damaged": 1, "blurred": 1, "duplicate": 1, "close": 1}
    assert len(found["candidates"]) == 6
    assert {one["reason"] for one in found["candidates"]} <= set(found["meanings"])


def photo(seed):
    blocks = texture(120, 200, seed=seed, coarseness=20)
    return cv2.GaussianBlur(blocks, (0, 0), 3)


def choose(pictures):
    """`pictures` by file name, None for one that cannot be read."""
    looks = [None if one is None else measure_photo(one) for one in pictures.values()]
    return choose_photos("room", list(pictures), [f"{one}.png" for one in pictures], looks)


def reasons(candidates):
    return {one.source: one.reason for one in candidates}


def test_what_is_left_out_is_named():
    pictures = {
        "a": photo(1), "b": photo(2), "c": photo(3), "copy": photo(2), "cap": photo(4) * 0,
        "broken": None}
    found = choose(pictures)
    assert reasons(found)["broken"] is Reason.DAMAGED
    assert reasons(found)["cap"] is Reason.CLIPPED
    repeats, clipped = describe_dropped(found)
    assert_facts(repeats, 1, "copy (like b)")
    assert_facts(clipped, 1, "black", "cap")


def test_many_names_are_cut_short():
    pictures = {"a": photo(1), "b": photo(2), "c": photo(3)} | {
        f"copy{index}": photo(1) for index in range(12)}
    assert_facts(describe_dropped(choose(pictures))[0], 7)


@pytest.mark.parametrize("count", [3, 12])
def test_copies_of_one_photo_are_refused(count):
    with raises(InputError, count, 1, "different") as caught:
        choose({str(index): photo(1) for index in range(count)})
    assert_facts(caught.value.hint, "step", "apart")


def test_photos_that_are_all_black_are_refused():
    with raises(InputError, 4, "photos"):
        choose({str(index): photo(index) // 50 for index in range(4)})
