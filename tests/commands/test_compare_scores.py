"""`recon eval A B C` in process: workspaces and files in one table, paired where that is right."""

import csv
import json
import shutil

import pytest
from PIL import Image, ImageOps
from posed_sets import make_replica

from recon_cli.cli import main


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Two trainings of one capture, one of them pruned, and one of another capture."""
    base = tmp_path_factory.mktemp("rooms")
    make_replica(base / "room", frames=8, tests=2)
    make_replica(base / "room2", frames=8, tests=2)
    for path in (base / "room2" / "test" / "results").glob("*.jpg"):
        ImageOps.invert(Image.open(path)).save(path)
    options = ["--iterations", "12", "--max-gaussians", "200", "--validation", "0.2"]
    for name, capture in (("a", "room"), ("other", "room2")):
        assert main(["ingest", str(base / capture), "-w", str(base / name)]) == 0
        assert main(["train", "-w", str(base / name), *options]) == 0
    shutil.copytree(base / "a", base / "b")
    assert main(["train", "-w", str(base / "b"), *options, "--seed", "1"]) == 0
    assert main(["prune", "-w", str(base / "a"), "--recovery", "2"]) == 0
    return base


def compared(capsys, *words):
    capsys.readouterr()
    assert main(["eval", *map(str, words)]) == 0
    return capsys.readouterr().out


def as_json(text):
    return json.loads(text[text.index("{"):])


@pytest.mark.integration
def test_models_of_workspaces_stand_in_one_table_with_what_each_scored_alone(room, capsys):
    found = as_json(compared(capsys, room / "a", room / "b", "--form", "json"))
    assert [(one["workspace"], one["model"]) for one in found["models"]] == [
        ("a", "base"), ("a", "pruned"), ("b", "base")]
    alone = json.loads((room / "a" / "evaluate" / "metrics.json").read_text())
    for one in found["models"][:2]:
        assert one["psnr_db"] == pytest.approx(alone["models"][one["model"]]["psnr_db"])
        assert one["gaussians"] == alone["models"][one["model"]]["gaussians"]


@pytest.mark.integration
def test_models_of_one_capture_are_paired_with_the_first(room, capsys):
    found = as_json(compared(capsys, room / "a", room / "b", "--form", "json"))
    first, second, third = found["models"]
    assert [(one["ours"], one["theirs"]) for one in found["differences"]] == [
        (second["label"], first["label"]), (third["label"], first["label"])]
    for one, model in zip(found["differences"], (second, third), strict=True):
        assert one["psnr_db"]["mean"] == pytest.approx(model["psnr_db"] - first["psnr_db"])
        assert one["psnr_db"]["low"] <= one["psnr_db"]["mean"] <= one["psnr_db"]["high"]


@pytest.mark.integration
def test_models_of_two_captures_are_not_paired_though_their_views_have_the_same_names(
    room, capsys
):
    found = as_json(compared(capsys, room / "b", room / "other", "--form", "json"))
    names = [[view["name"] for view in one["views"]] for one in found["models"]]
    assert names[0] == names[1]
    assert found["differences"] == []


@pytest.mark.integration
def test_a_file_scores_what_the_workspace_it_came_from_scores(room, tmp_path, capsys):
    copy = tmp_path / "handed out.ply"
    copy.write_bytes((room / "a" / "prune" / "splats.ply").read_bytes())
    found = as_json(compared(
        capsys, room / "a", copy, "-w", room / "a", "--form", "json"))
    _, pruned, file = found["models"]
    assert file["label"] == "handed out.ply"
    assert file["psnr_db"] == pytest.approx(pruned["psnr_db"], abs=1e-9)
    assert file["train_seconds"] is None
    assert file["truth_digest"] == pruned["truth_digest"]


@pytest.mark.integration
def test_a_file_that_was_handed_out_in_another_frame_scores_the_same(room, tmp_path, capsys):
    out = shutil.copytree(room / "a", tmp_path / "turned")
    assert main(["export", "-w", str(out), "--up", "y", "--backdrop", "keep"]) == 0
    found = as_json(compared(
        capsys, room / "a", out / "export" / "splats.ply", "-w", room / "a", "--form", "json"))
    _, pruned, file = found["models"]
    assert file["psnr_db"] == pytest.approx(pruned["psnr_db"], abs=1e-4)
    (out / "export" / "transform.json").write_text("{}")
    assert main(["eval", str(out / "export" / "splats.ply"), "-w", str(room / "a")]) == 3
    assert "transform.json" in capsys.readouterr().err


@pytest.mark.integration
def test_paths_of_one_name_are_told_apart_in_every_table(room, tmp_path, capsys):
    twin = tmp_path / "a"
    shutil.copytree(room / "b", twin)
    found = as_json(compared(capsys, room / "a", twin, "--form", "json"))
    labels = [one["label"] for one in found["models"]]
    assert labels == [f"{room / 'a'}, original", f"{room / 'a'}, compact", f"{twin}, original"]
    means = [line for line in compared(capsys, room / "a", twin, "--form", "csv").splitlines()
             if ",mean," in line]
    assert len(means) == 3


@pytest.mark.integration
def test_each_workspace_keeps_to_its_own_settings(room, tmp_path, capsys, monkeypatch):
    (tmp_path / "workspace").mkdir()
    (tmp_path / "workspace" / "recon.toml").write_text("[train]\niterations = 7\n")
    monkeypatch.chdir(tmp_path)  # where -w is not given, it is ./workspace
    assert as_json(compared(capsys, room / "a", "--form", "json"))["models"]
    shutil.copytree(room / "b", tmp_path / "small")
    (tmp_path / "small" / "recon.toml").write_text("[evaluate]\nmax_size = 20\n")
    compared(capsys, tmp_path / "small", "--form", "json")
    metrics = json.loads((tmp_path / "small" / "evaluate" / "metrics.json").read_text())
    assert metrics["width"] == 20


@pytest.mark.integration
def test_every_form_holds_the_figures(room, capsys):
    found = as_json(compared(capsys, room / "a", "--form", "json"))
    shown = f"{found['models'][0]['psnr_db']:.2f}"
    text = compared(capsys, room / "a")
    assert shown in text
    assert "difference, 95%" in text
    assert "PSNR original" in text  # both models are there: the paper's table
    assert f"| {shown} |" in compared(capsys, room / "a", "--form", "markdown")
    assert r"\begin{tabular}" in compared(capsys, room / "a", "--form", "latex")
    lines = compared(capsys, room / "a", "--form", "csv").splitlines()
    rows = list(csv.DictReader(lines[[line.startswith("model,") for line in lines].index(True):]))
    means = [row for row in rows if row["view"] == "mean"]
    assert float(means[0]["psnr_db"]) == pytest.approx(found["models"][0]["psnr_db"], abs=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize(("make", "code", "words"), [
    (lambda folder: folder / "nowhere", 3, "does not exist"),
    (lambda folder: folder, 3, "neither a workspace"),
])
def test_what_is_no_model_is_refused_before_anything_runs(
    room, tmp_path, capsys, make, code, words
):
    assert main(["eval", str(room / "a"), str(make(tmp_path))]) == code
    assert words in capsys.readouterr().err


@pytest.mark.integration
def test_a_file_that_is_no_splats_a_twin_and_a_workspace_without_cameras_are_refused(
    room, tmp_path, capsys
):
    (tmp_path / "x.ply").write_bytes(b"ply\n")
    assert main(["eval", str(tmp_path / "x.ply"), "-w", str(room / "a")]) == 3
    assert main(["eval", str(room / "a"), str(room / "a")]) == 2
    assert "twice" in capsys.readouterr().err
    assert main(["eval", str(tmp_path / "x.ply"), "-w", str(tmp_path / "ws")]) == 4
    assert "recon ingest" in capsys.readouterr().err
