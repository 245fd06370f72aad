"""`recon run --minutes`: what each part of a run gets, by a clock that fake stages move on."""

from __future__ import annotations

from pathlib import Path

import pytest

from recon_cli.commands import budget
from recon_cli.commands.options import Call
from recon_cli.workspace.atomic import read_json

SLOWNESS = 1.5


class FakeRun:
    """Stages that take so many seconds.

    `train` takes its minutes times a factor, `prune` a share of its minutes.
    """

    def __init__(self, monkeypatch, seconds, *, longer=1.0, pruning=0.4):
        self.now, self.ran, self.seconds, self.longer = 0.0, [], seconds, longer
        self.pruning, self.training = pruning, 0.0
        for name, value in {
                "run_stages": self.run, "measure_slowness": lambda _: SLOWNESS,
                "_most_frames": self.choose_frames, "_report_frames": lambda *_: None,
                "_pruning_seconds": lambda _: self.pruning * self.training}.items():
            monkeypatch.setattr(budget, name, value)

    def __call__(self):
        return self.now

    def choose_frames(self, _inputs, left, *_):
        self.left_at_first = left
        return 60

    def run(self, call, _verb, stages, *, base, **_):
        for stage in stages:
            if stage == "ingest":
                assert base["ingest"] == {"max_frames": 60}
            if stage == "sfm":
                self.sfm_left = call.deadline.left
            self.ran.append(stage)
            if stage == "train":
                self.training = 60 * base["train"]["minutes"] * self.longer
            self.now += {**self.seconds, "train": self.training,
                         "prune": self.pruning * self.training}[stage]


USUAL = {"ingest": 8.0, "denoise": 3.0, "sfm": 40.0, "place": 0.0, "evaluate": 20.0, "export": 10.0}


def run(tmp_path, clock, minutes, *, with_prune=True):
    tmp_path.mkdir(exist_ok=True)
    budget.run_within(
        Call(workspace=tmp_path), minutes, (Path("a.mp4"),), {}, with_prune=with_prune, clock=clock)
    return read_json(tmp_path / budget.FILE, dict)


@pytest.mark.parametrize("minutes", [2.0, 4.0, 8.0])
def test_the_parts_of_a_run_add_up_to_its_minutes(tmp_path, monkeypatch, minutes, caplog):
    clock = FakeRun(monkeypatch, {**USUAL, "sfm": 20.0 * minutes})
    chosen = run(tmp_path, clock, minutes)
    assert 0.85 <= clock.now / (60 * minutes) <= 1.15
    assert chosen["prune"] is (minutes > 2)
    assert chosen["max_frames"] == 60
    assert clock.ran.count("ingest") == 1
    given_up = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(given_up) == (not chosen["prune"])


def test_cameras_get_a_share_of_what_ingest_left(tmp_path, monkeypatch):
    clock = FakeRun(monkeypatch, {**USUAL, "ingest": 30.0})
    run(tmp_path, clock, 4.0)
    scores = budget._SCORES * SLOWNESS
    assert clock.left_at_first == pytest.approx(240 - scores)
    assert clock.sfm_left == pytest.approx(budget._SFM * (240 - 30 - scores) - USUAL["denoise"])


def test_pruning_that_has_no_time_is_left_out_and_said(tmp_path, monkeypatch, caplog):
    clock = FakeRun(monkeypatch, USUAL, longer=1.4, pruning=0.9)
    assert run(tmp_path, clock, 2.0)["prune"] is False
    assert "prune" not in clock.ran
    assert "no time to prune" in caplog.text


def test_training_gets_the_time_of_a_pruning_that_would_be_too_short(tmp_path, monkeypatch):
    clock = FakeRun(monkeypatch, {**USUAL, "sfm": 50.0})
    chosen = run(tmp_path, clock, 2.0)
    assert chosen["prune"] is False
    assert 60 * chosen["train_minutes"] == pytest.approx(
        120 - 8 - 3 - 50 - budget._SCORES * SLOWNESS, abs=0.5)
    assert 0.85 <= clock.now / 120 <= 1.15


def test_a_run_that_goes_on_keeps_what_was_chosen(tmp_path, monkeypatch):
    chosen = run(tmp_path, FakeRun(monkeypatch, USUAL), 4.0)
    slow = FakeRun(monkeypatch, {**USUAL, "sfm": 150.0}, pruning=9.0)
    assert run(tmp_path, slow, 4.0) == chosen
