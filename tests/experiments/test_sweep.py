"""`recon prune --sweep` in process, on a small data set: table, controls, and nothing touched."""

import json

import pytest
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.evaluation.scores import MeanScore, Sweep, SweepTrial
from recon_cli.experiments.sweep import SCORES, count_trials, table

RATIOS = (0.5, 0.9)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A small Replica sequence that was trained on."""
    base = tmp_path_factory.mktemp("replica")
    make_replica(base / "room", frames=8, tests=2)
    assert main(["ingest", str(base / "room"), "-w", str(base / "ws")]) == 0
    options = ["--iterations", "60", "--max-gaussians", "200", "--validation", "0.2"]
    assert main(["train", "-w", str(base / "ws"), *options]) == 0
    assert main(["prune", "-w", str(base / "ws"), "--recovery", "4"]) == 0
    return base / "ws"


@pytest.fixture(scope="module")
def swept(workspace):
    """What the stages left before the sweep, and its exit code and result."""
    before = {path: path.read_bytes() for path in workspace.glob("*/*") if path.is_file()}
    code = main(["prune", "--sweep", "--ratios", "0.5,0.9", "--recovery", "6", "-w",
                 str(workspace)])
    return before, code, json.loads((workspace / "sweep.json").read_text())


def test_every_score_meets_every_ratio_and_the_controls_stand_beside(swept):
    _, code, found = swept
    assert code == 0
    assert len(found["trials"]) == count_trials(RATIOS)
    for ratio in RATIOS:
        names = [one["score"] for one in found["trials"] if one["ratio"] == ratio]
        assert names == [*SCORES, Sweep.CONTROL]
    assert found["trials"][0]["score"] == Sweep.CONTROL  # no prune, equal steps
    assert found["trials"][0]["steps"] == found["recovery_steps"] == 6


def test_the_counts_are_those_of_the_ratios_and_nothing_goes_in_the_controls(swept):
    trials_found = swept[2]["trials"]
    n = trials_found[0]["gaussians"]
    for one in trials_found:
        gone = 0 if one["score"] == Sweep.CONTROL else int(one["ratio"] * n)
        assert one["gaussians"] == n - gone
        assert (one["removed"] is None) == (one["score"] == Sweep.CONTROL)


def test_a_sweep_says_which_training_it_is_of(workspace, swept):
    manifest = json.loads((workspace / "train" / "manifest.json").read_text())
    assert swept[2]["of_train"] == manifest["digest"]


def test_scores_are_of_the_views_that_were_kept_out_of_training(swept):
    assert swept[2]["validation_views"] >= 1
    for one in swept[2]["trials"]:
        assert 5 < one["recovered"]["psnr_db"] < 60
        assert -1 <= one["recovered"]["ssim"] <= 1


def test_a_sweep_touches_no_result_and_makes_nothing_stale(workspace, swept, capsys):
    before, _, _ = swept
    assert {path: path.read_bytes() for path in before} == before
    assert sorted(path.name for path in workspace.glob("sweep*"))[0] == "sweep.json"
    capsys.readouterr()
    assert main(["status", "--json", "-w", str(workspace)]) == 0
    states = {one["name"]: one["state"] for one in json.loads(capsys.readouterr().out)["stages"]}
    assert (states["train"], states["prune"]) == ("fresh", "fresh")


@pytest.mark.usefixtures("swept")
def test_the_picture_is_an_svg_that_names_every_score(workspace):
    pytest.importorskip("matplotlib")
    picture = (workspace / "sweep.svg").read_text()
    assert "<svg" in picture
    for name in SCORES:  # text is drawn as paths, with the words in comments
        assert f"<!-- {name} -->" in picture


def test_without_validation_views_there_is_nothing_to_score_on(tmp_path, capsys):
    make_replica(tmp_path / "room", frames=8, tests=2)
    workspace = str(tmp_path / "ws")
    assert main(["ingest", str(tmp_path / "room"), "-w", workspace]) == 0
    assert main(["train", "-w", workspace, "--iterations", "2", "--validation", "0"]) == 0
    assert main(["prune", "--sweep", "-w", workspace]) == 5
    said = capsys.readouterr().err
    assert "the run has none" in said
    assert "recon train --validation 0.05" in said
    assert not (tmp_path / "ws" / "sweep.json").exists()


@pytest.mark.parametrize("ratios", ["", "half", "0.5,1", "0,0.5", "0.5,,0.8"])
def test_ratios_that_are_none_are_a_usage_error(ratios, capsys):
    assert main(["prune", "--sweep", "--ratios", ratios]) == 2
    assert "a list of fractions" in capsys.readouterr().err


def test_a_table_says_what_is_equal_in_each_control():
    good = MeanScore(30.0, 0.9)
    text = table([
        SweepTrial(Sweep.CONTROL, None, 100, 60, 6.0, None, good),
        SweepTrial("loo", 0.8, 20, 60, 3.0, MeanScore(20.0, 0.5), good),
        SweepTrial(Sweep.CONTROL, 0.8, 100, 30, 3.0, None, good)], "loo").text()
    lines = text.splitlines()
    assert "equal steps" in lines[1]
    assert "80%" in lines[2]
    assert "20.00" in lines[2]
    assert "seconds of loo 0.8" in lines[3]
