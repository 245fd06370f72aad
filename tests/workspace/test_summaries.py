"""Records between stages: what is written is read back, and another version is named."""

import json
from dataclasses import replace

import pytest
import summaries
from facts import raises

from recon_cli.errors import ManifestError
from recon_cli.workspace.summaries import (
    AttemptSummary,
    IngestSummary,
    LogRow,
    PlaceSummary,
    PosesSummary,
    PruneSummary,
    TrainSummary,
    WorldSummary,
)

ATTEMPT = AttemptSummary(
    name="relaxed", reason="few cameras", skipped="", registered=9, models=(9, 3), weak_link=None,
    reprojection_error_px=0.5, seconds=1.5, kept=True)
MAPPED = replace(
    summaries.PLACE, attempts=(ATTEMPT,), apart=(("a.png", "b.png"),), rejected={"c.png": "wrong"},
    poses=PosesSummary(use="refine", metric=True, moved_median=0.1))


@pytest.mark.parametrize("record", [MAPPED, *summaries.BY_STAGE.values()])
def test_a_record_comes_back_from_json_as_it_was(record):
    assert type(record).from_json(json.loads(json.dumps(record.to_json()))) == record


def test_the_keys_are_the_fields_in_order_without_what_does_not_apply():
    assert list(summaries.INGEST.to_json()) == [
        "kind", "declared_frames", "decoded_frames", "lost_frames", "dropped_blurred", "skipped",
        "frames", "held_out", "groups", "width", "height"]
    assert summaries.PLACE.to_json()["poses"] is None
    assert MAPPED.to_json()["poses"] == {"use": "refine", "metric": True, "moved_median": 0.1}


def test_a_record_of_another_version_is_refused_with_what_it_lacks():
    value = MAPPED.to_json()
    del value["world"]["evidence"]["up_found"]
    with raises(ManifestError, "up_found"):
        PlaceSummary.from_json(value)
    with raises(ManifestError, "JSON"):
        PlaceSummary.from_json({**value, "world": 3})


def test_a_value_of_another_type_is_refused_with_its_name():
    with raises(ManifestError, "3.5"):
        TrainSummary.from_json({**summaries.TRAIN.to_json(), "gaussians": 3.5})
    with raises(ManifestError, "rounds", "version"):
        PruneSummary.from_json({**summaries.PRUNE.to_json(), "rounds": None})


def test_a_log_is_read_without_an_incomplete_last_line(tmp_path):
    log = tmp_path / "log.jsonl"
    assert LogRow.read_all(log) == ()
    log.write_text('{"iteration": 5, "seconds": 1.5}\n{"iteration": 9, "sec')
    assert LogRow.read_all(log) == (LogRow(iteration=5, seconds=1.5),)


def test_what_another_version_added_is_ignored():
    value = summaries.INGEST.to_json()
    assert IngestSummary.from_json({**value, "lenses": 3}) == summaries.INGEST


def test_the_world_is_read_from_the_folder_of_sfm(tmp_path):
    assert WorldSummary.read(tmp_path) is None
    (tmp_path / "world.json").write_text(json.dumps(summaries.WORLD.to_json()))
    assert WorldSummary.read(tmp_path) == summaries.WORLD


@pytest.mark.parametrize(("options", "contradicted"), [
    ({"accept_weak": False, "partial": True}, False),
    ({"accept_weak": True, "partial": True}, True),
    ({"accept_weak": False, "partial": False}, True)])
def test_a_part_of_a_broken_model_contradicts_options_that_keep_all_or_nothing(
    options, contradicted
):
    assert bool(replace(MAPPED, left_out=("d.png",)).contradictions(options)) == contradicted
    assert MAPPED.contradictions(options) == ()


@pytest.mark.parametrize(("asked", "segments", "contradicted"), [
    ("auto", 1, False), ("auto", 3, False), ("off", 1, False), ("off", 3, True), ("3", 3, False),
    ("4", 3, True)])
def test_a_model_of_other_segments_than_asked_for_is_stale(asked, segments, contradicted):
    options = {"accept_weak": False, "partial": True, "segments": asked}
    mapped = replace(MAPPED, segments=segments)
    assert bool(mapped.contradictions(options)) == contradicted
