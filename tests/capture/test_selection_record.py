import json

import numpy as np

from recon_cli.capture.selection_record import Reason, count_reasons, video_candidates, write_choice

REFUSED = (None, None, Reason.BLURRED, None, Reason.DAMAGED, None)
WAY = np.array([0.0, 0.0, 0.05, 0.08, 0.1, 0.12])


def record():
    names = {0: "000000.png", 5: "000005.png"}
    return video_candidates("room.mp4", np.full(6, 7.123), REFUSED, WAY, names, same=0.001)


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
