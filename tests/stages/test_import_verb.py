"""`recon import` in process: what stays, what is refused, and what follows the scene."""

import json

import pytest
import torch
from facts import assert_facts
from foreign import recon, truth, with_views

from recon_cli.cli import main
from recon_cli.config.settings import read_settings
from recon_cli.pipeline.plan import Job, status
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.spz import write_spz
from recon_cli.workspace.digests import digest_file
from recon_cli.workspace.layout import Workspace


@pytest.fixture
def scene(tmp_path):
    write_ply(tmp_path / "scene.ply", truth())
    return tmp_path / "scene.ply"


@pytest.fixture
def workspace(tmp_path):
    return with_views(tmp_path / "views")


@pytest.fixture
def alone(tmp_path, scene):
    """A workspace with a scene and without views."""
    assert recon("import", tmp_path / "alone", scene, "--max-size", 96) == 0
    return tmp_path / "alone"


def states(workspace):
    return {one.name: one.state for one in status(Job(Workspace(workspace)))}


def train_of(workspace):
    return next(one for one in status(Job(Workspace(workspace))) if one.name == "train")


def test_a_scene_is_fresh_and_says_where_it_comes_from(alone, scene, capsys):
    assert states(alone)["train"] == "fresh"
    assert recon_status(alone, capsys).count("scene.ply") == 1
    manifest = json.loads((alone / "train" / "manifest.json").read_text())
    (source,) = manifest["inputs"]
    assert source["files"]["scene.ply"]["sha256"] == digest_file(scene).sha256
    assert recon("import", alone, scene, "--max-size", 96) == 0
    assert "up to date" in capsys.readouterr().out


def recon_status(workspace, capsys):
    assert main(["status", "-w", str(workspace)]) == 0
    return capsys.readouterr().out


def test_another_file_makes_the_scene_stale_and_a_lost_one_does_not(alone, scene):
    write_ply(scene, truth().select(torch.arange(40)))
    (reason,) = train_of(alone).reasons
    assert_facts(reason, "scene.ply", "changed")
    assert recon("import", alone, "--max-size", 96) == 0  # remembers which file
    assert len(read_ply(alone / "train" / "splats.ply")) == 40
    scene.unlink()
    assert train_of(alone).state == "fresh"
    assert_facts(train_of(alone).notices[0], scene, "gone")


def test_without_views_files_are_written_and_checked(alone, capsys):
    assert recon("export", alone, "--format", "spz,glb,points.ply") == 0
    assert_facts(capsys.readouterr().err, "views", "checked")
    assert {"splats.spz", "splats.glb", "points.ply"} <= {
        path.name for path in (alone / "export").iterdir()}
    assert states(alone)["export"] == "fresh"
    assert recon("export", alone, "--format", "spz", "--max-loss", "0", "--again") == 5
    assert_facts(capsys.readouterr().err, "synthetic")


@pytest.mark.parametrize("words", [
    ("--max-mb", "1"), ("--drop-floaters",), ("--format", "colmap"),
    ("--format", "transforms.json"), ("--format", "mesh.glb"),
    ("--scale-between", "a.png", "b.png", "1")])
def test_what_only_views_can_tell_is_refused_without_them(alone, words, capsys):
    assert recon("export", alone, *words) == 4
    assert "recon ingest CAPTURE" in capsys.readouterr().err
    assert not (alone / "export").exists()


def test_without_views_an_orbit_is_rendered_and_no_view(alone, capsys):
    short = ["--seconds", "1", "--fps", "3", "--size", "48"]
    assert recon("render", alone, "--path", "orbit", *short) == 0
    assert len(list((alone / "render" / "orbit-rgb" / "rgb").iterdir())) == 3
    for words in ([], ["--views", "test"]):
        assert recon("render", alone, *words) == 4
        assert "--path orbit" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["prune", "eval"])
def test_without_views_nothing_is_pruned_or_scored(alone, verb, capsys):
    assert recon(verb, alone) == 4
    assert "recon ingest VIDEO" in capsys.readouterr().err


@pytest.mark.integration
def test_training_does_not_replace_an_imported_scene_unasked(workspace, scene, capsys):
    assert recon("import", workspace, scene) == 0
    before = (workspace / "train" / "splats.ply").read_bytes()
    for verb in ("train", "run"):
        assert recon(verb, workspace) == 4
        assert f"recon {verb} --again" in capsys.readouterr().err
    assert (workspace / "train" / "splats.ply").read_bytes() == before
    assert recon("train", workspace, "--again", "--iterations", "5", "--max-size", "48") == 0
    assert states(workspace)["train"] == "fresh"
    assert not (workspace / "train" / "import.json").exists()


@pytest.mark.integration
def test_an_import_does_not_replace_a_trained_scene_unasked(workspace, scene, capsys):
    assert recon("train", workspace, "--iterations", "5", "--max-size", "48") == 0
    before = (workspace / "train" / "splats.ply").read_bytes()
    assert recon("import", workspace, scene) == 4
    assert_facts(capsys.readouterr().err, "scene", "trained")
    assert (workspace / "train" / "splats.ply").read_bytes() == before
    assert recon("import", workspace, scene, "--again") == 0
    assert read_ply(workspace / "train" / "splats.ply").means.shape == (60, 3)


def test_a_file_that_cannot_be_read_leaves_everything_as_it_was(alone, tmp_path, capsys):
    before = (alone / "train" / "manifest.json").read_bytes()
    (tmp_path / "broken.spz").write_bytes(b"no spz")
    assert recon("import", alone, tmp_path / "broken.spz") == 3
    assert recon("import", alone, tmp_path / "missing.ply") == 3
    assert "hint" in capsys.readouterr().err
    assert (alone / "train" / "manifest.json").read_bytes() == before
    assert states(alone)["train"] == "fresh"


@pytest.mark.integration
def test_with_views_later_stages_follow_the_scene(workspace, scene, tmp_path):
    assert recon("import", workspace, scene) == 0
    assert recon("eval", workspace) == 0
    assert recon("export", workspace, "--format", "spz,colmap", "--max-loss", "30") == 0
    assert states(workspace)["evaluate"] == states(workspace)["export"] == "fresh"
    write_spz(tmp_path / "other.spz", truth())
    assert recon("import", workspace, tmp_path / "other.spz") == 0
    assert states(workspace)["evaluate"] == states(workspace)["export"] == "stale"


def test_views_that_come_later_make_the_scene_stale_until_it_is_held_against_them(
    workspace, scene, capsys
):
    away = workspace.parent / "away"
    for name in ("ingest", "place"):
        away.mkdir(exist_ok=True)
        (workspace / name).rename(away / name)
    assert recon("import", workspace, scene) == 0
    for name in ("ingest", "place"):
        (away / name).rename(workspace / name)
    for reason, name in zip(sorted(train_of(workspace).reasons), ("ingest", "place"), strict=True):
        assert_facts(reason, name, "missing")
    assert recon("eval", workspace) == 4
    assert "recon import" in capsys.readouterr().err
    assert recon("import", workspace) == 0
    assert train_of(workspace).summary["views"] > 0


def test_an_import_without_a_file_says_what_to_type(tmp_path, capsys):
    assert recon("import", tmp_path / "ws") == 2
    assert "recon import FILE" in capsys.readouterr().err


def test_the_options_are_printed_as_toml(tmp_path, capsys):
    assert recon("import", tmp_path / "ws", "--print-config", "--axes", "z-up") == 0
    assert 'axes = "z-up"' in capsys.readouterr().out
    assert not (tmp_path / "ws").exists()


def test_the_reason_names_the_section_that_sets_the_option(alone):
    (alone / "recon.toml").write_text("[import]\nmax_size = 80\n[train]\niterations = 7\n")
    settings = read_settings(alone / "recon.toml")
    (found,) = [one for one in status(Job(Workspace(alone), settings)) if one.name == "train"]
    (reason,) = found.reasons
    assert_facts(reason, "import.max_size", 96, 80)
