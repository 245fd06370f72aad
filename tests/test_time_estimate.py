"""The time of work that is told before it is done: the sum of costs, and how fast a machine is."""

import time

import pytest

from recon_cli import time_estimate
from recon_cli.time_estimate import (
    COSTS,
    PIECE_SECONDS,
    Cost,
    TimeEstimator,
    Work,
    estimate_for_notice,
    format_minutes,
    list_mapping,
    measure_machine,
    measure_slowness,
)

ONES = {"walk": Cost(1, 1), "keyframe": Cost(1), "walk_mapping": Cost(1), "photo": Cost(10, 10),
        "photo_mapping": Cost(10), "split": Cost(100), "join": Cost(1000)}


def walk(frames, megapixels, **facts):
    return list_mapping(frames, megapixels, tracked=True, **facts)


def test_work_costs_its_pieces_and_their_sizes_and_threads_share_some_of_it():
    here = TimeEstimator({"read": Cost(2, 0.5), "write": Cost(each=3)}, threads=4, slowness=1.5)
    assert here.total([]) == 0
    assert here.total([Work("read", 10, 6), Work("write", 2, 7)]) == 1.5 * (10 * 5 + 2 * 21)
    assert here.total([Work("read", 10, 6, shared=True)]) == 1.5 * 10 * 5 / 4


def test_a_walk_pays_for_its_frames_and_pixels_on_all_cores_and_for_its_mapping_on_one():
    assert TimeEstimator(ONES).total(walk(60, 2.0)) == 60 * (1 + 2 + 1 + 1)
    assert TimeEstimator(ONES, 4).total(walk(60, 2.0)) == 60 * (4 / 4 + 1)


def test_a_walk_of_few_keyframes_is_mapped_in_less_time():
    assert TimeEstimator(ONES).total(walk(60, 2.0, keyframes=20)) == 60 * 3 + 20 * 2


def test_segments_are_mapped_at_once_and_joined_on_one_core():
    four = TimeEstimator(ONES, 4)
    assert four.total(walk(60, 2.0, segments=3)) == pytest.approx(70 * 5 / 4 + 60 * 1000)
    photos = list_mapping(60, 2.0, tracked=False, segments=3)
    assert four.total(photos) == pytest.approx(70 * 40 / 4 + 60 * 100 / 4 + 60 * 1000)


# CPU seconds of finished workspaces on the machine of COSTS (tests/bench/notes/cameras.md).
@pytest.mark.parametrize(("frames", "keyframes", "megapixels", "took"), [
    (75, 75, 0.204, 62), (75, 75, 0.204, 68), (60, 60, 0.204, 61), (60, 60, 0.204, 48),
    (29, 29, 0.307, 28), (50, 50, 2.07, 166), (360, 184, 0.194, 208)])
def test_what_walks_took_is_told_within_a_third(frames, keyframes, megapixels, took):
    work = walk(frames, megapixels, keyframes=keyframes)
    assert TimeEstimator(COSTS).total(work) == pytest.approx(took, rel=1 / 3)


def test_a_measured_machine_takes_its_times_of_the_costs(monkeypatch):
    monkeypatch.setattr(time_estimate, "measure_slowness", lambda threads: 10.0 * threads)
    assert measure_machine(2) == TimeEstimator(COSTS, 2, 20.0)


def test_a_machine_that_multiplies_slowly_is_slower(monkeypatch):
    usual, product = measure_slowness(1), time_estimate.np.matmul

    def multiply_slowly(a, b):
        time.sleep(5 * PIECE_SECONDS)
        return product(a, b)

    monkeypatch.setattr(time_estimate.np, "matmul", multiply_slowly)
    assert measure_slowness(1) > max(5, usual)


def test_a_machine_is_measured_in_a_fraction_of_a_second():
    start = time.process_time()
    slowness = measure_slowness(2)
    assert time.process_time() - start < 100 * PIECE_SECONDS * time_estimate.MEASURES
    assert 0.05 < slowness < 1000


def test_a_short_capture_is_told_nothing_and_not_measured(monkeypatch):
    monkeypatch.setattr(time_estimate, "measure_slowness", None)
    assert estimate_for_notice(walk(20, 0.2), 2) is None


@pytest.mark.parametrize(("seconds", "text"), [
    (60, "1 minute"), (75, "1.2 minutes"), (596, "9.9 minutes"), (598, "10 minutes"),
    (7000, "117 minutes")])
def test_minutes_are_told_as_well_as_they_are_known(seconds, text):
    assert format_minutes(seconds) == text
