"""`recon train --from-import`: an imported scene with views is trained further."""

import json
import shutil

import pytest
import torch
from facts import assert_facts
from foreign import recon, truth, with_views

from recon_cli.cli import main
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.train.fit import runner
from recon_cli.train.fit.state import save_state
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.records import ImportRecord

pytestmark = pytest.mark.integration

FURTHER = ("--from-import", "--iterations", "120", "--max-size", "48", "--validation", "0.2")


@pytest.fixture
def scene(tmp_path):
    """A file with a scene that is a little off."""
    splats = truth()
    splats.sh_dc = splats.sh_dc + 0.2 * torch.randn(
        splats.sh_dc.shape, generator=torch.Generator().manual_seed(0))
    write_ply(tmp_path / "room.ply", splats)
    return tmp_path / "room.ply"


@pytest.fixture
def workspace(tmp_path, scene):
    """A workspace with views and that scene imported."""
    workspace = with_views(tmp_path / "views")
    assert recon("import", workspace, scene, "--validation", "0.2") == 0
    return workspace


def summary(workspace):
    return Workspace(workspace).manifest("train").run.summary


def test_an_imported_scene_gets_better_and_says_where_it_comes_from(workspace, capsys):
    imported = Workspace(workspace).manifest("train")
    assert recon("eval", workspace) == 0
    before = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    assert recon("train", workspace, *FURTHER) == 0
    assert_facts(capsys.readouterr().err, "room.ply")
    assert Workspace(workspace).manifest("train").key.continues == imported.digest
    assert summary(workspace)["imported_from"] == "room.ply"
    assert "continued_from_step" not in summary(workspace)
    assert main(["status", "-w", str(workspace)]) == 0
    out = capsys.readouterr().out
    assert_facts(out, 120, "iterations")
    assert_facts(out, "room.ply")
    for verb in ("eval", "prune", "export"):
        assert recon(verb, workspace) == 0
    assert_facts(capsys.readouterr().err, "trained", "held-out", "views")
    after = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    assert after["imported_from"] == "room.ply"
    gain = after["models"]["base"]["psnr_db"] - before["models"]["base"]["psnr_db"]
    assert gain > 3


def test_training_it_further_goes_on_and_nothing_else_replaces_it(workspace, capsys):
    assert recon("train", workspace, *FURTHER) == 0
    before = (workspace / "train" / "splats.ply").read_bytes()
    assert recon("train", workspace, *FURTHER) == 0
    assert "up to date" in capsys.readouterr().out
    for words in (("--iterations", "50"), ("--iterations", "200"), ("--seed", "1", *FURTHER[1:])):
        assert recon("train", workspace, *words) == 4
        assert_facts(capsys.readouterr().err, "room.ply")
    assert (workspace / "train" / "splats.ply").read_bytes() == before
    assert recon("train", workspace, "--iterations", "200", *FURTHER[3:]) == 0
    assert (summary(workspace)["imported_from"], summary(workspace)["continued_from_step"]) == (
        "room.ply", 120)
    assert recon("train", workspace, "--again", "--iterations", "20", *FURTHER[3:]) == 0
    assert "imported_from" not in summary(workspace)
    assert not (workspace / "train" / "import.json").exists()


def test_a_higher_degree_and_exposure_can_be_added(workspace):
    assert recon("train", workspace, *FURTHER, "--sh-degree", "1", "--exposure", "on") == 0
    assert read_ply(workspace / "train" / "splats.ply").sh_degree == 1
    assert summary(workspace)["parts"]["exposure"] == "on"


def test_an_interrupted_one_resumes_and_the_import_stays(workspace, scene, monkeypatch):
    assert recon("train", workspace, *FURTHER) == 0
    whole = (workspace / "train" / "splats.ply").read_bytes()
    assert recon("import", workspace, scene, "--again", "--validation", "0.2") == 0
    imported = (workspace / "train" / "manifest.json").read_bytes()

    def save_then_stop(path, state):
        save_state(path, state)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(runner, "save_state", save_then_stop)
        assert recon("train", workspace, *FURTHER, "--checkpoint-every", "50") == 130
    assert (workspace / "train" / "manifest.json").read_bytes() == imported
    assert recon("train", workspace, *FURTHER[1:]) == 0  # as recon said: the same command again
    assert (workspace / "train" / "splats.ply").read_bytes() == whole
    assert ImportRecord.read(workspace / "train").file == "room.ply"


@pytest.mark.parametrize(("words", "says"), [
    (("--max-gaussians", "50"), "has 60 Gaussians"), (("--background", "on"), "background is on")])
def test_options_that_contradict_the_scene_are_refused(workspace, words, says, capsys):
    assert recon("train", workspace, *FURTHER, *words) == 2
    assert says in capsys.readouterr().err
    assert "iterations" not in summary(workspace)


def test_without_an_import_or_its_views_there_is_nothing_to_train(tmp_path, scene, capsys):
    assert recon("import", tmp_path / "alone", scene) == 0
    assert recon("train", tmp_path / "alone", *FURTHER) == 4
    assert "recon ingest VIDEO" in capsys.readouterr().err
    bare = with_views(tmp_path / "bare")
    assert recon("train", bare, *FURTHER) == 4
    assert_facts(capsys.readouterr().err, "imported", "scene")
    assert not (bare / "train").exists()


def test_a_scene_that_was_not_compared_with_the_views_as_they_are_is_refused(
    workspace, tmp_path, scene, capsys
):
    views = tmp_path / "later"
    views.mkdir()
    assert recon("import", views, scene, "--max-size", "48") == 0
    for name in ("ingest", "denoise", "sfm", "place"):
        shutil.copytree(workspace / name, views / name)
    assert recon("train", views, *FURTHER) == 4
    assert_facts(capsys.readouterr().err, "been", "compared", "views")
    assert recon("import", views, "--max-size", "48") == 0
    assert recon("train", views, *FURTHER) == 0
