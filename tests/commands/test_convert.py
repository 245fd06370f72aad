"""The verbs convert and info on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from archive_splats import room
from facts import assert_facts

from recon_cli.cli import main
from recon_cli.splats.ply import read_ply, write_ply


@pytest.fixture(autouse=True)
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(Path("a.ply"), room(40))
    Path("move.json").write_text("[[1, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]")


def test_files_are_merged_and_the_outcome_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["convert", "a.ply", "a.ply", "b.ply", "--transform", "-", "--transform",
                 "move.json"]) == 0
    assert_facts(capsys.readouterr().out, "b.ply", 80, 3)
    means = read_ply(Path("b.ply")).means
    assert torch.allclose(means[40:, 0], means[:40, 0] + 9)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply", "move.json"]


@pytest.mark.parametrize(("arguments", "code", "said"), [
    (["a.ply"], 2, "Missing argument 'OUT'"),
    (["a.ply", "a.ply"], 3, "exists already"),
    (["none.ply", "b.ply"], 3, "none.ply"),
    (["a.ply", "b.ply", "--transform", "-", "--transform", "-"], 2, "2 times --transform"),
    (["a.ply", "b.ply", "--transform", "a.ply"], 3, "cannot be read as JSON"),
    (["a.ply", "b.ply", "--scale", "0"], 2, "--scale")])
def test_what_cannot_be_converted_is_refused(
    arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", *arguments]) == code
    assert said in capsys.readouterr().err
    assert not Path("b.ply").exists()


def test_info_prints_lines_or_json_and_reads_on_after_a_damaged_file(
    capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", "a.ply"]) == 0
    assert_facts(capsys.readouterr().out, 40, 3, "degree")
    Path("bad.ply").write_text("ply")
    assert main(["info", "bad.ply", "a.ply", "--json"]) == 3
    printed = capsys.readouterr()
    assert [item["gaussians"] for item in json.loads(printed.out)] == [40]
    assert_facts(printed.err, "error:", "bad.ply")
