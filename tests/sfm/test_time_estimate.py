"""The time of sfm that is told: the costs of each kind of capture, and how fast a machine is."""

import time

import pytest

from recon_cli.sfm.mapping import time_estimate
from recon_cli.sfm.mapping.time_estimate import (
    COSTS,
    PIECE_SECONDS,
    Costs,
    Workload,
    estimate_for_notice,
    expected_seconds,
    format_minutes,
    measure_slowness,
)

ONES = Costs(walk=1, walk_megapixel=1, keyframe=1, walk_mapping=1, photo=10, photo_megapixel=10,
             photo_mapping=10, split=100, join=1000)


def test_a_walk_pays_for_its_frames_and_pixels_on_all_cores_and_for_its_mapping_on_one():
    work = Workload(60, 2.0, tracked=True)
    assert expected_seconds(work, 1, costs=ONES) == 60 * (1 + 2 + 1 + 1)
    assert expected_seconds(work, 4, costs=ONES) == 60 * (4 / 4 + 1)


def test_a_walk_of_few_keyframes_is_mapped_in_less_time():
    work = Workload(60, 2.0, tracked=True, keyframes=20)
    assert expected_seconds(work, 1, costs=ONES) == 60 * 3 + 20 * 2


def test_segments_are_mapped_at_once_and_joined_on_one_core():
    work = Workload(60, 2.0, tracked=True, segments=3)
    assert expected_seconds(work, 4, costs=ONES) == pytest.approx(70 * 5 / 4 + 60 * 1000)
    photos = Workload(60, 2.0, tracked=False, segments=3)
    assert expected_seconds(photos, 4, costs=ONES) == pytest.approx(
        70 * 40 / 4 + 60 * 100 / 4 + 60 * 1000)


# CPU seconds of finished workspaces on the machine of COSTS (tests/bench/notes/cameras.md).
@pytest.mark.parametrize(("frames", "keyframes", "megapixels", "took"), [
    (75, 75, 0.204, 62), (75, 75, 0.204, 68), (60, 60, 0.204, 61), (60, 60, 0.204, 48),
    (29, 29, 0.307, 28), (50, 50, 2.07, 166), (360, 184, 0.194, 208)])
def test_what_walks_took_is_told_within_a_third(frames, keyframes, megapixels, took):
    work = Workload(frames, megapixels, tracked=True, keyframes=keyframes)
    assert expected_seconds(work, 1, costs=COSTS) == pytest.approx(took, rel=1 / 3)


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
    assert estimate_for_notice(Workload(20, 0.2, tracked=True), 2) is None


@pytest.mark.parametrize(("seconds", "text"), [
    (60, "1 minute"), (75, "1.2 minutes"), (596, "9.9 minutes"), (598, "10 minutes"),
    (7000, "117 minutes")])
def test_minutes_are_told_as_well_as_they_are_known(seconds, text):
    assert format_minutes(seconds) == text
