"""`recon eval --seeds N` in process: models trained again with other seeds, mean and deviation."""

import json
import shutil
import statistics

import pytest
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.evaluation.intervals import Spread

pytestmark = pytest.mark.integration

OPTIONS = ["--iterations", "30", "--max-gaussians", "200", "--validation", "0.2", "--seed", "4"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A workspace with a model of seed 4 and a pruned one."""
    base = tmp_path_factory.mktemp("seeds")
    make_replica(base / "room", frames=8, tests=2)
    assert main(["ingest", str(base / "room"), "-w", str(base / "w")]) == 0
    assert main(["train", "-w", str(base / "w"), *OPTIONS]) == 0
    assert main(["prune", "-w", str(base / "w"), "--recovery", "4"]) == 0
    return base / "w"


@pytest.fixture
def workspace(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "w")


def over(workspace, capsys, *words):
    capsys.readouterr()
    assert main(["eval", "-w", str(workspace), *words]) == 0
    return capsys.readouterr().out


def test_mean_and_deviation_are_those_of_models_trained_by_hand(workspace, tmp_path, capsys):
    found = json.loads(over(workspace, capsys, "--seeds", "2", "--form", "json"))
    alone = shutil.copytree(workspace, tmp_path / "alone")
    assert main(["train", "-w", str(alone), *OPTIONS[:-1], "5"]) == 0
    assert main(["prune", "-w", str(alone), "--recovery", "4"]) == 0
    assert main(["eval", "-w", str(alone)]) == 0
    scores = [json.loads((w / "evaluate" / "metrics.json").read_text())["models"]
              for w in (workspace, alone)]
    assert found["seeds"] == [4, 5]
    for model in ("base", "pruned"):
        values = [one[model]["psnr_db"] for one in scores]
        assert found["models"][model]["psnr_db"]["values"] == pytest.approx(values)
        assert found["models"][model]["psnr_db"]["mean"] == pytest.approx(statistics.fmean(values))
        assert found["models"][model]["psnr_db"]["deviation"] == pytest.approx(
            statistics.stdev(values))
        assert values[0] != values[1]
    gaps = [one["pruned"]["ssim"] - one["base"]["ssim"] for one in scores]
    assert found["pruned_minus_base"]["ssim"]["values"] == pytest.approx(gaps)
    assert json.loads((workspace / "seeds.json").read_text()) == found


def test_the_workspace_stays_fresh_and_its_frames_are_linked(workspace, capsys):
    before = (workspace / "train" / "splats.ply").read_bytes()
    over(workspace, capsys, "--seeds", "2")
    assert (workspace / "train" / "splats.ply").read_bytes() == before
    assert main(["status", "--json", "-w", str(workspace)]) == 0
    states = {one["name"]: one["state"] for one in json.loads(capsys.readouterr().out)["stages"]}
    assert states["train"] == states["prune"] == states["evaluate"] == "fresh"
    frame = next((workspace / "ingest" / "frames").iterdir())
    twin = workspace / "seeds" / "5" / "ingest" / "frames" / frame.name
    assert twin.stat().st_ino == frame.stat().st_ino


def test_what_is_trained_is_not_trained_again(workspace, capsys):
    over(workspace, capsys, "--seeds", "2")
    splats = workspace / "seeds" / "5" / "train" / "splats.ply"
    first = splats.stat().st_mtime_ns
    text = over(workspace, capsys, "--seeds", "2")
    assert splats.stat().st_mtime_ns == first
    assert "±" in text
    assert "seeds 4, 5" in text


def test_new_settings_train_the_seeds_again(workspace, capsys):
    over(workspace, capsys, "--seeds", "2")
    again = [*OPTIONS[:1], "20", *OPTIONS[2:]]
    assert main(["train", "-w", str(workspace), *again]) == 0
    over(workspace, capsys, "--seeds", "2")
    manifest = json.loads((workspace / "seeds" / "5" / "train" / "manifest.json").read_text())
    assert manifest["config"]["iterations"] == 20
    assert manifest["config"]["seed"] == 5


def test_clean_frees_the_other_seeds_and_keeps_their_scores(workspace, capsys):
    over(workspace, capsys, "--seeds", "2")
    assert main(["clean", "-w", str(workspace)]) == 0
    assert not any((workspace / "seeds").iterdir())
    assert (workspace / "seeds.json").is_file()
    assert (workspace / "ingest" / "frames").is_dir()


def test_every_form_holds_every_model(workspace, capsys):
    for form, mark in (("text", "±"), ("markdown", "| --- |"), ("latex", "\\toprule"),
                       ("csv", "base,4,")):
        assert mark in over(workspace, capsys, "--seeds", "1" if form == "csv" else "2",
                            "--form", form)


def test_seeds_and_items_exclude_each_other(workspace, capsys):
    assert main(["eval", str(workspace), "--seeds", "2"]) == 2
    assert "without ITEM" in capsys.readouterr().err


def test_without_a_model_the_command_to_type_is_named(tmp_path, capsys):
    assert main(["eval", "-w", str(tmp_path / "none"), "--seeds", "2"]) == 4
    assert "recon" in capsys.readouterr().err


def test_one_seed_has_no_deviation():
    assert Spread.from_values((2.0,)).deviation is None
    assert Spread.from_values((1.0, 3.0)).deviation == pytest.approx(2**0.5)
    assert Spread.from_values((2.0,)).text(".1f") == "2.0"
