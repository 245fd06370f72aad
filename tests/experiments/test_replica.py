"""The rooms of Replica in a folder, and the command that fills the paper's tables with them."""

from __future__ import annotations

import csv
import json
import logging
from pathlib import Path

import pytest
from facts import assert_facts, raises
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.errors import InputError
from recon_cli.experiments import runner
from recon_cli.experiments.paper_tables import TABLE_I
from recon_cli.experiments.replica import find_rooms


def room(folder: Path) -> Path:
    (folder / "results").mkdir(parents=True)
    (folder / "traj.txt").touch()
    return folder


def test_rooms_come_in_the_order_of_the_paper_and_missing_ones_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("room1", "Room0", "office3", "cam_params"):
        room(tmp_path / name)
    with caplog.at_level(logging.WARNING, "recon"):
        found = find_rooms(tmp_path)
    assert [path.name for path in found] == ["office3", "Room0", "room1"]
    for name in TABLE_I:
        assert (name in caplog.text) == (name not in ("office3", "room0", "room1"))


def test_all_rooms_are_found_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in TABLE_I:
        room(tmp_path / name)
    assert [path.name for path in find_rooms(tmp_path)] == list(TABLE_I)
    assert not caplog.text


def test_another_folder_is_refused_with_the_layout(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    with raises(InputError, "office0") as caught:
        find_rooms(tmp_path)
    assert "traj.txt" in (caught.value.hint or "")
    with raises(InputError, "folder"):
        find_rooms(tmp_path / "nothing")


def test_one_room_in_place_of_their_folder_is_recognised(tmp_path: Path) -> None:
    with raises(InputError, "room") as caught:
        find_rooms(room(tmp_path / "room0"))
    assert str(tmp_path) in (caught.value.hint or "")


@pytest.mark.parametrize("lacks", ["traj.txt", "results"])
def test_an_incomplete_room_is_refused_before_anything_runs(tmp_path: Path, lacks: str) -> None:
    room(tmp_path / "room0")
    path = room(tmp_path / "room1") / lacks
    if path.is_dir():
        path.rmdir()
    else:
        path.unlink()
    with raises(InputError, "room1", lacks):
        find_rooms(tmp_path)


@pytest.mark.integration
def test_one_command_fills_the_tables_and_a_second_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_replica(tmp_path / "disk" / "scan", frames=16, tests=0)
    (tmp_path / "replica").mkdir()
    (tmp_path / "replica" / "office1").symlink_to(tmp_path / "disk" / "scan")  # of another name
    make_replica(tmp_path / "home", frames=16, tests=0)
    words = ["study", "--replica", str(tmp_path / "replica"), str(tmp_path / "home"),
             "--out", str(tmp_path / "out"), "--iterations", "12", "--max-size", "32",
             "--max-gaussians", "200", "--threads", "1", "--device", "cpu"]
    assert main(words) == 0
    record = json.loads((tmp_path / "out" / "study.json").read_text())
    assert (record["seeds"], record["base"]["images"]) == (1, "original")
    assert record["scenes"]["office1"]["views"] == 2  # every 8th of 16
    assert list(record["comparisons"]) == ["equal steps"]
    rows = list(csv.reader((tmp_path / "out" / "study.csv").read_text().splitlines()))
    filled = {row[0]: row[1:] for row in rows if len(row) == 11}
    assert filled["office1"][:4] == ["36.97", "0.938", "37.17", "0.954"]
    assert all(float(cell) > 0 for cell in filled["office1"][4:])
    assert set(filled["office0"][4:]) == {"-"}
    assert all(float(cell) > 0 for cell in filled["home"][4:])
    latex = (tmp_path / "out" / "study.tex").read_text()
    assert r"\midrule" in latex
    assert_facts(latex, 1, "mean")
    capsys.readouterr()
    monkeypatch.setattr(runner, "run_trial", lambda *_, **__: pytest.fail("ran"))
    assert main(words) == 0
    assert_facts(capsys.readouterr().err, 6, "runs", "kept")


def test_the_command_refuses_a_wrong_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", "--replica", str(tmp_path), "--out", str(tmp_path / "out")]) == 3
    assert_facts(capsys.readouterr().err, "room", "paper")
    assert not (tmp_path / "out").exists()
