"""Exports add to their folder: what stays, what is named stale, and what becomes of a user's files.

On a scene that was imported without views, through the command line.
"""

from __future__ import annotations

import json
import os
import shutil

import pytest
import torch

from recon_cli.cli import main
from recon_cli.context import EarlierResult
from recon_cli.export import format_writer
from recon_cli.export.kept_files import keep_files
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.workspace.export_record import ExportedFile, LossLimit
from recon_cli.workspace.layout import Workspace

pytestmark = pytest.mark.integration

BOX = ["--crop", "-9", "-9", "-9", "0", "9", "9"]
BOX_TEXT = "--crop -9 -9 -9 0 9 9"


def scene(count=20, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(shape, generator=generator)

    return Splats(
        normal(count, 3), normal(count, 4), torch.full((count, 3), -1.5), torch.full((count,), 2.0),
        0.5 * normal(count, 3), torch.zeros(count, 0, 3))


def run(verb, workspace, *words):
    """Returns the exit code."""
    return main([verb, *words, "-w", str(workspace), "--backend", "numba", "--threads", "1"])


@pytest.fixture(scope="module")
def _imported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("imported")
    write_ply(folder / "room.ply", scene())
    assert run("import", folder / "ws", str(folder / "room.ply"), "--max-size", "24") == 0
    assert run("export", folder / "ws", "--format", "spz,points.ply") == 0
    return folder / "ws"


@pytest.fixture
def ws(_imported, tmp_path):
    """A workspace with splats.ply, splats.spz and points.ply."""
    shutil.copytree(_imported, tmp_path / "ws")
    return tmp_path / "ws"


def contents(workspace):
    folder = workspace / "export"
    return {path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*") if path.is_file()}


def record(workspace):
    return json.loads((workspace / "export" / "manifest.json").read_text())["summary"]


def stale_files(workspace):
    files = record(workspace)["files"].items()
    return {name: one["stale"] for name, one in files if "stale" in one}


def test_a_format_that_is_not_asked_for_again_stays_and_nothing_runs(ws, capsys):
    before = contents(ws)
    assert run("export", ws) == 0
    assert "up to date: splats.ply, splats.spz, points.ply" in capsys.readouterr().out
    assert run("export", ws, "--format", "spz") == 0
    assert contents(ws) == before


def test_another_format_is_added_and_what_is_fresh_is_not_written_again(ws):
    before = (ws / "export" / "splats.spz").stat()
    assert run("export", ws, "--format", "glb,spz") == 0
    assert {"splats.ply", "splats.spz", "splats.glb", "points.ply"} <= contents(ws).keys()
    after = (ws / "export" / "splats.spz").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert stale_files(ws) == {}


def test_again_writes_what_is_asked_for_again_and_keeps_the_rest(ws):
    before, expected = (ws / "export" / "splats.spz").stat().st_ino, contents(ws)
    assert run("export", ws, "--format", "spz", "--again") == 0
    assert (ws / "export" / "splats.spz").stat().st_ino != before
    after = contents(ws)
    assert {name: after[name] for name in ("splats.ply", "splats.spz", "points.ply")} == {
        name: expected[name] for name in ("splats.ply", "splats.spz", "points.ply")}


def test_what_no_longer_fits_the_ply_is_kept_and_named_with_the_reason(ws, capsys):
    before = contents(ws)
    assert run("export", ws, *BOX) == 0
    err = capsys.readouterr().err
    assert f"splats.spz is stale: it was written before {BOX_TEXT}" in err
    assert "--format spz" in err
    after = contents(ws)
    assert after["splats.spz"] == before["splats.spz"]
    assert after["splats.ply"] != before["splats.ply"]
    assert main(["status", "-w", str(ws)]) == 0
    assert f"splats.spz is stale: it was written before {BOX_TEXT}" in capsys.readouterr().err
    assert run("export", ws, *BOX) == 0  # up to date, and says so again
    out, err = capsys.readouterr()
    assert "up to date" in out
    assert "splats.spz is stale" in err


def test_a_file_is_fresh_again_once_the_options_are_those_it_was_made_with(ws):
    assert run("export", ws, *BOX, "--format", "glb") == 0
    assert set(stale_files(ws)) == {"spz", "points.ply"}
    assert run("export", ws) == 0
    assert stale_files(ws) == {"glb": f"it was written with {BOX_TEXT}"}


def test_another_model_makes_every_format_stale(ws, tmp_path):
    write_ply(tmp_path / "other.ply", scene(seed=1))
    assert run("import", ws, str(tmp_path / "other.ply"), "--max-size", "24") == 0
    assert run("export", ws) == 0
    assert stale_files(ws) == dict.fromkeys(
        ("spz", "points.ply"), "it was made from an earlier training")


def test_an_option_of_one_format_makes_that_one_stale_alone(ws, capsys):
    assert run("export", ws, "--format", "spz", "--spz-version", "2") == 0
    assert "splats.spz is stale: it was written with --spz-version 3" in capsys.readouterr().err
    assert stale_files(ws) == {}


def test_a_format_that_loses_too_much_takes_none_of_those_that_pass(ws, capsys, monkeypatch):
    monkeypatch.setattr(
        format_writer, "loss_limit", lambda name, _: LossLimit(-1.0 if name == "glb" else 0.5))
    assert run("export", ws, "--format", "glb,splat") == 5
    err = capsys.readouterr().err
    assert "glb: " in err
    assert "may lose" in err
    assert "splats.splat" in err
    assert {"splats.splat", "splats.spz"} <= contents(ws).keys()
    assert "splats.glb" not in contents(ws)
    assert run("export", ws, "--format", "glb") == 5  # it is tried again, not taken for up to date
    assert run("export", ws, "--format", "splat") == 0


def test_a_format_that_may_be_left_out_is_named_and_leaves_the_export_fresh(
    ws, capsys, monkeypatch
):
    monkeypatch.setattr(
        format_writer, "loss_limit", lambda name, _: LossLimit(-1.0 if name == "glb" else 0.5))
    words = ["--format", "glb,splat", "--skip-lossy"]
    assert run("export", ws, *words) == 0
    assert "splats.glb was not written: glb: " in capsys.readouterr().err
    assert "splats.splat" in contents(ws)
    assert run("export", ws, *words) == 0
    assert "export is up to date" in capsys.readouterr().out
    assert main(["status", "-w", str(ws)]) == 0
    assert "stale" not in capsys.readouterr().out
    assert run("export", ws, "--format", "glb") == 5  # who asks for it hears why


def test_a_file_of_before_stays_where_a_format_fails(ws, monkeypatch):
    before = contents(ws)["splats.spz"]
    monkeypatch.setattr(format_writer, "loss_limit", lambda _name, _options: LossLimit(-1.0))
    assert run("export", ws, "--format", "spz", *BOX) == 5
    assert contents(ws)["splats.spz"] == before
    assert "spz" in stale_files(ws)


def test_files_of_the_user_stay_and_may_change(ws, capsys):
    (ws / "export" / "notes").mkdir()
    (ws / "export" / "notes" / "a.txt").write_text("mine")
    (ws / "export" / "gone.txt").symlink_to("nowhere")
    assert run("export", ws, "--format", "glb") == 0
    assert (ws / "export" / "notes" / "a.txt").read_text() == "mine"
    assert (ws / "export" / "gone.txt").is_symlink()
    (ws / "export" / "notes" / "a.txt").write_text("changed")
    capsys.readouterr()
    assert run("export", ws) == 0
    assert "up to date" in capsys.readouterr().out
    assert run("export", ws, *BOX) == 0
    assert (ws / "export" / "notes" / "a.txt").read_text() == "changed"


def test_what_was_changed_by_hand_is_kept_under_another_name_where_it_is_written_again(ws, capsys):
    folder, edited = ws / "export", read_ply(ws / "export" / "splats.ply")
    edited.sh_dc += 0.1
    write_ply(folder / "splats.ply", edited)
    mine = (folder / "splats.ply").read_bytes()
    (folder / "splats.spz").write_bytes(b"mine")
    assert run("export", ws) == 0
    assert "kept as splats.kept.ply" in capsys.readouterr().err
    assert (folder / "splats.kept.ply").read_bytes() == mine
    assert (folder / "splats.spz").read_bytes() == b"mine"
    assert stale_files(ws) == {"spz": "it was changed by hand"}
    assert run("export", ws, *BOX) == 0  # and is still named so
    assert stale_files(ws)["spz"] == "it was changed by hand"
    assert run("export", ws, *BOX, "--format", "spz") == 0
    assert (folder / "splats.kept.spz").read_bytes() == b"mine"
    assert (folder / "splats.kept.ply").read_bytes() == mine


def test_without_a_manifest_that_can_be_read_files_are_kept_as_stale(ws):
    before = contents(ws)
    (ws / "export" / "manifest.json").write_text("{")
    assert run("export", ws) == 7
    assert contents(ws).keys() == before.keys()
    assert run("export", ws, "--again") == 0
    assert contents(ws)["splats.spz"] == before["splats.spz"]
    assert set(stale_files(ws)) == {"spz", "points.ply"}


@pytest.mark.parametrize("place", ["write", "seal"])
def test_an_export_that_is_interrupted_leaves_all_as_it_was_and_can_be_repeated(
    ws, monkeypatch, place
):
    before = contents(ws)

    def interrupt(*_args, **_options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(*((format_writer.FormatWriter, "write") if place == "write" else (
            Workspace, "seal")), interrupt)
        assert run("export", ws, "--format", "glb", *BOX) == 130
    assert contents(ws) == before
    assert run("export", ws, "--format", "glb", *BOX) == 0
    assert contents(ws)["splats.spz"] == before["splats.spz"]
    assert run("export", ws, "--again") == 0
    after = contents(ws)
    assert {name: after[name] for name in before if name != "manifest.json"} == {
        name: before[name] for name in before if name != "manifest.json"}


def test_a_file_is_copied_where_links_do_not_work(ws, monkeypatch):
    def refuse(*_args, **_options):
        raise OSError("no links here")

    before = contents(ws)["splats.spz"]
    monkeypatch.setattr(os, "link", refuse)
    assert run("export", ws, *BOX) == 0
    assert contents(ws)["splats.spz"] == before


def test_a_scene_of_one_gaussian_is_written_in_every_format(tmp_path):
    write_ply(tmp_path / "one.ply", scene(1))
    assert run("import", tmp_path / "ws", str(tmp_path / "one.ply"), "--max-size", "24") == 0
    formats = "ply,compressed.ply,splat,spz,sog,glb,html,lod,points.ply"
    assert run("export", tmp_path / "ws", "--format", formats) == 0
    assert len(record(tmp_path / "ws")["files"]) == 8


def test_a_folder_of_the_user_with_the_name_of_a_file_is_kept_whole_under_another(tmp_path):
    earlier, out = tmp_path / "earlier", tmp_path / "out"
    (earlier / "splats.ply" / "deep").mkdir(parents=True)
    out.mkdir()
    (out / "splats.ply").write_text("new")
    for name in ("a.txt", "deep/b.txt"):
        (earlier / "splats.ply" / name).write_text(name)
    result = EarlierResult(earlier, {}, foreign=frozenset({
        "splats.ply/a.txt", "splats.ply/deep/b.txt"}))
    kept = keep_files(out, result, {}, ["ply"])
    assert (out / "splats.ply").read_text() == "new"
    assert kept.own_files == ("splats.kept.ply/a.txt", "splats.kept.ply/deep/b.txt")
    assert (out / "splats.kept.ply" / "deep" / "b.txt").read_text() == "deep/b.txt"


def test_files_left_of_a_format_that_is_written_again_are_not_kept(tmp_path):
    earlier, out = tmp_path / "earlier", tmp_path / "out"
    for name in ("lod/lod-meta.json", "lod/0_0/meta.json", "lod/0_9/meta.json", "images/a.png",
                 "images/gone.png", "sparse/0/images.bin", "transforms.json",
                 "sparse/0/points3D.ply"):
        (earlier / name).parent.mkdir(parents=True, exist_ok=True)
        (earlier / name).write_text("old")
    for name in ("lod/lod-meta.json", "lod/0_0/meta.json", "images/a.png", "sparse/0/images.bin"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("new")
    # INRIA's reader wrote points3D.ply; beside another model it would be read in place of its own
    result = EarlierResult(earlier, {}, foreign=frozenset({"sparse/0/points3D.ply"}))
    records = {"lod": ExportedFile(file="lod/lod-meta.json"),
               "transforms.json": ExportedFile(file="transforms.json")}
    kept = keep_files(out, result, records, ["ply", "lod", "colmap"])
    assert set(kept.files) == {"transforms.json"}
    assert {path.relative_to(out).as_posix(): path.read_text()
            for path in out.rglob("*") if path.is_file()} == {
        "lod/lod-meta.json": "new", "lod/0_0/meta.json": "new", "images/a.png": "new",
        "images/gone.png": "old", "sparse/0/images.bin": "new", "transforms.json": "old",
        "sparse/0/points3D.kept.ply": "old"}
    assert kept.own_files == ("sparse/0/points3D.kept.ply",)
