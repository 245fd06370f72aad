"""Results that share a folder: what stays, what is stale, and what becomes of a user's files.

Exports of a scene that was imported without views, through the command line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import json
import os
import shutil

import pytest
import torch
from facts import assert_facts

from recon_cli.cli import main
from recon_cli.export import format_writer
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.workspace import durable, layout
from recon_cli.workspace.digests import digest_file, matches
from recon_cli.workspace.export_formats import EXPORT_FORMATS, LossLimit
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import Manifest, ResultKey, RunRecord

pytestmark = pytest.mark.integration

BOX = ["--crop", "-9", "-9", "-9", "0", "9", "9"]


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


def files_of(workspace):
    return {name: data for name, data in contents(workspace).items() if "manifest" not in name}


def states(workspace):
    """The state and reasons of each exported format, as `recon status` has them."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(["status", "--json", "-w", str(workspace)]) == 0
    return {stage["name"]: (stage["state"], *stage["reasons"])
            for stage in json.loads(out.getvalue())["stages"]
            if stage["name"].startswith("export")}


def stale_formats(workspace):
    return {name.removeprefix("export."): reasons[0]
            for name, (state, *reasons) in states(workspace).items() if state != "fresh"}


def only_loses(monkeypatch, name):
    """Makes one format lose more than it may; an empty name: all."""
    monkeypatch.setattr(format_writer.LossLimit, "from_option", staticmethod(
        lambda row, _: LossLimit(-1.0 if row.name == name or not name else 0.5)))


def test_a_format_that_is_not_asked_for_again_stays_and_nothing_runs(ws, capsys):
    before = contents(ws)
    assert run("export", ws) == 0
    assert capsys.readouterr().out == "export is up to date\n"
    assert run("export", ws, "--format", "spz") == 0
    assert contents(ws) == before


def test_another_format_is_added_and_what_is_fresh_is_not_written_again(ws):
    names = ("splats.ply", "splats.spz")
    before = [(ws / "export" / name).stat() for name in names]
    assert run("export", ws, "--format", "glb,spz") == 0
    assert {"splats.ply", "splats.spz", "splats.glb", "points.ply"} <= contents(ws).keys()
    after = [(ws / "export" / name).stat() for name in names]
    assert [(one.st_ino, one.st_mtime_ns) for one in after] == [
        (one.st_ino, one.st_mtime_ns) for one in before]
    assert states(ws) == dict.fromkeys(
        ("export", "export.spz", "export.glb", "export.points.ply"), ("fresh",))


def test_again_writes_what_is_asked_for_again_and_keeps_the_rest(ws):
    before, expected = (ws / "export" / "splats.spz").stat().st_ino, files_of(ws)
    assert run("export", ws, "--format", "spz", "--again") == 0
    assert (ws / "export" / "splats.spz").stat().st_ino != before
    assert files_of(ws) == expected


def test_what_no_longer_fits_the_ply_is_kept_and_named_with_the_reason(ws, capsys):
    before = contents(ws)
    assert run("export", ws, *BOX) == 0
    err = capsys.readouterr().err
    assert_facts(err, "splats.spz")
    assert "--format spz" in err
    after = contents(ws)
    assert after["splats.spz"] == before["splats.spz"]
    assert after["splats.ply"] != before["splats.ply"]
    state, reason = states(ws)["export.spz"]
    assert state == "stale"
    assert_facts(reason, "export's")
    assert run("export", ws, *BOX) == 0  # up to date, and says so again
    out, err = capsys.readouterr()
    assert "up to date" in out
    assert_facts(err, "splats.spz")


def test_a_file_is_fresh_again_once_the_ply_is_that_which_it_was_made_with(ws):
    assert run("export", ws, *BOX, "--format", "glb") == 0
    assert set(stale_formats(ws)) == {"spz", "points.ply"}
    assert run("export", ws) == 0
    assert set(stale_formats(ws)) == {"glb"}


def test_another_model_makes_every_format_stale(ws, tmp_path):
    write_ply(tmp_path / "other.ply", scene(seed=1))
    assert run("import", ws, str(tmp_path / "other.ply"), "--max-size", "24") == 0
    assert run("export", ws) == 0
    assert stale_formats(ws) == dict.fromkeys(("spz", "points.ply"), "train's output changed")


@pytest.mark.parametrize(("words", "state"), [
    (["--format", "spz", "--spz-version", "2"], "ran"),
    (["--format", "spz", "--max-loss", "0.2"], "ran"),
    (["--format", "spz", "--title", "Room"], "kept"),
    (["--format", "points.ply", "--spz-version", "2"], "kept"),
])
def test_an_option_makes_only_the_formats_stale_that_it_decides_on(ws, words, state):
    before = (ws / "export" / EXPORT_FORMATS[words[1]].file).stat().st_mtime_ns
    assert run("export", ws, *words) == 0
    after = (ws / "export" / EXPORT_FORMATS[words[1]].file).stat().st_mtime_ns
    assert (after != before) is (state == "ran")
    assert stale_formats(ws) == {}


def test_a_format_that_loses_too_much_takes_none_of_those_that_pass(ws, capsys, monkeypatch):
    only_loses(monkeypatch, "glb")
    assert run("export", ws, "--format", "glb,splat") == 5
    err = capsys.readouterr().err
    assert_facts(err, "glb:", "dB")
    assert "splats.splat" in err
    assert {"splats.splat", "splats.spz"} <= contents(ws).keys()
    assert "splats.glb" not in contents(ws)
    assert run("export", ws, "--format", "glb") == 5  # it is tried again, not taken for up to date
    assert run("export", ws, "--format", "splat") == 0


def test_a_format_that_may_be_left_out_is_named_and_leaves_the_export_fresh(
    ws, capsys, monkeypatch
):
    only_loses(monkeypatch, "glb")
    assert run("export", ws, "--format", "glb,splat", "--skip-lossy") == 0
    assert_facts(capsys.readouterr().err, "export.glb")
    assert "splats.splat" in contents(ws)
    assert stale_formats(ws) == {}
    assert run("export", ws, "--format", "glb") == 5  # who asks for it hears why


def test_a_file_of_before_stays_where_a_format_fails(ws, monkeypatch):
    before = contents(ws)["splats.spz"]
    only_loses(monkeypatch, "")
    assert run("export", ws, "--format", "spz", *BOX) == 5
    assert contents(ws)["splats.spz"] == before
    assert "spz" in stale_formats(ws)


def test_files_of_the_user_stay_and_may_change(ws, capsys):
    (ws / "export" / "notes").mkdir()
    (ws / "export" / "notes" / "a.txt").write_text("mine")
    (ws / "export" / "gone.txt").symlink_to("nowhere")
    assert run("export", ws, "--format", "glb", *BOX) == 0
    assert (ws / "export" / "notes" / "a.txt").read_text() == "mine"
    assert (ws / "export" / "gone.txt").is_symlink()
    (ws / "export" / "notes" / "a.txt").write_text("changed")
    capsys.readouterr()
    assert run("export", ws, *BOX) == 0
    assert "up to date" in capsys.readouterr().out


def test_what_was_changed_by_hand_is_kept_under_another_name_where_it_is_written_again(ws, capsys):
    folder, edited = ws / "export", read_ply(ws / "export" / "splats.ply")
    edited.sh_dc += 0.1
    write_ply(folder / "splats.ply", edited)
    mine = (folder / "splats.ply").read_bytes()
    (folder / "splats.spz").write_bytes(b"mine")
    assert run("export", ws) == 0
    assert_facts(capsys.readouterr().err, "splats.kept.ply")
    assert (folder / "splats.kept.ply").read_bytes() == mine
    assert (folder / "splats.spz").read_bytes() == b"mine"
    assert stale_formats(ws).keys() == {"spz"}
    assert_facts(stale_formats(ws)["spz"], "splats.spz", "hand")
    assert run("export", ws, *BOX) == 0  # and is still named so
    assert_facts("\n".join(states(ws)["export.spz"]), "splats.spz", "hand")
    assert run("export", ws, *BOX, "--format", "spz") == 0
    assert (folder / "splats.kept.spz").read_bytes() == b"mine"
    assert (folder / "splats.kept.ply").read_bytes() == mine


def test_what_is_removed_by_hand_is_written_again(ws):
    expected = files_of(ws)
    (ws / "export" / "splats.spz").unlink()
    assert stale_formats(ws).keys() == {"spz"}
    assert_facts(stale_formats(ws)["spz"], "splats.spz", "missing")
    assert run("export", ws, "--format", "spz") == 0
    assert files_of(ws) == expected


@pytest.mark.parametrize("name", ["manifest.json", "manifest.spz.json"])
def test_without_a_manifest_that_can_be_read_files_are_kept(ws, name):
    before = files_of(ws)
    (ws / "export" / name).write_text("{")
    assert run("export", ws, "--format", "spz") == 7
    assert files_of(ws) == before
    assert run("export", ws, "--format", "spz", "--again") == 0
    after = files_of(ws)
    assert {name: after[name] for name in before} == before
    assert stale_formats(ws) == {}


def stop_at(monkeypatch, place):
    """Interrupts the next export while it writes, is sealed, moves files in, or has done so."""
    def interrupt(*_args, **_options):
        raise KeyboardInterrupt

    def interrupt_late(source, target):
        if (target.parent.name, target.name) == ("export", "manifest.glb.json"):
            raise KeyboardInterrupt
        os.replace(source, target)

    where = {"write": (format_writer.FormatWriter, "write", interrupt),
             "seal": (Workspace, "seal", interrupt), "move": (durable, "replace", interrupt_late),
             "tidy": (layout, "move", interrupt)}
    monkeypatch.setattr(*where[place])


@pytest.mark.parametrize("place", ["write", "seal", "move", "tidy"])
def test_an_export_that_is_interrupted_can_be_repeated_and_ends_the_same(
    ws, tmp_path, monkeypatch, place
):
    shutil.copytree(ws, tmp_path / "other")
    before = files_of(ws)
    with monkeypatch.context() as patch:
        stop_at(patch, place)
        assert run("export", ws, "--format", "glb") == 130
    assert {name: data for name, data in files_of(ws).items() if name in before} == before
    for workspace in (ws, tmp_path / "other"):
        assert run("export", workspace, "--format", "glb") == 0
    assert files_of(ws) == files_of(tmp_path / "other")
    assert states(ws)["export.glb"] == ("fresh",)
    assert not list((ws / ".partial").iterdir())


def test_a_result_that_was_damaged_after_a_crash_is_made_again(ws, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, "move")
        assert run("export", ws, "--format", "glb") == 130
    (ws / "export" / "splats.glb").write_bytes(b"damaged")
    assert run("export", ws, "--format", "glb") == 0
    assert (ws / "export" / "splats.glb").read_bytes()[:4] == b"glTF"
    assert states(ws)["export.glb"] == ("fresh",)


def test_one_format_is_cleaned_without_the_others(ws, capsys):
    before = files_of(ws)
    assert main(["clean", "export.spz", "--dry-run", "-w", str(ws)]) == 0
    assert "splats.spz" in capsys.readouterr().out
    assert files_of(ws) == before
    assert main(["clean", "export.spz", "-w", str(ws)]) == 0
    assert files_of(ws) == {
        name: data for name, data in before.items() if name != "splats.spz"}
    assert "export.spz" not in states(ws)
    assert main(["clean", "export", "-w", str(ws)]) == 0
    assert not (ws / "export").exists()


def test_an_export_of_the_version_before_opens_and_is_named_as_that(ws, capsys):
    """It had one manifest for all files, whose summary named the other formats."""
    folder, root = ws / "export", ws
    new = Manifest.read(folder)
    names = ("splats.ply", "transform.json", "splats.spz", "points.ply")
    old = dataclasses.replace(
        new, key=dataclasses.replace(new.key, version=6, config={
            **new.key.config, "format": "spz,points.ply", "spz_version": 3}),
        outputs={name: digest_file(folder / name) for name in names},
        run=dataclasses.replace(new.run, summary={**new.run.summary, "files": {
            "spz": {"file": "splats.spz", "bytes": 9, "made_of": {"version": 6}},
            "points.ply": {"file": "points.ply"}}}))
    for path in folder.glob("manifest*.json"):
        path.unlink()
    old.write(folder)
    expected = files_of(root)
    assert_facts("\n".join(states(root)["export"]), "version", 6, 7)
    assert run("export", root) == 0
    assert "splats.spz" in capsys.readouterr().err
    assert files_of(root) == expected
    assert set(stale_formats(root)) == {"spz", "points.ply"}
    assert run("export", root, "--format", "spz,points.ply") == 0
    assert files_of(root) == expected
    assert stale_formats(root) == {}


def test_a_scene_of_one_gaussian_is_written_in_every_format(tmp_path):
    write_ply(tmp_path / "one.ply", scene(1))
    assert run("import", tmp_path / "ws", str(tmp_path / "one.ply"), "--max-size", "24") == 0
    formats = "ply,compressed.ply,splat,spz,sog,glb,html,lod,points.ply"
    assert run("export", tmp_path / "ws", "--format", formats) == 0
    assert set(states(tmp_path / "ws").values()) == {("fresh",)}
    assert len(states(tmp_path / "ws")) == 9


def commit(root, stage, files):
    """Puts a result with these files in place, as a stage does."""
    workspace = Workspace(root)
    key = ResultKey(stage, 1, {}, (), {})
    workspace.discard(stage)
    out, _ = workspace.begin(key)
    for name, text in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    outputs = workspace.seal(stage)
    workspace.commit(Manifest(key, outputs, "", RunRecord(0.0, 0, {}, {}, None, None, 1, "")))


def test_a_folder_of_the_user_with_the_name_of_a_file_is_kept_whole_under_another(tmp_path):
    commit(tmp_path, "export", {"splats.ply": "new"})
    (tmp_path / "export" / "splats.spz" / "deep").mkdir(parents=True)
    (tmp_path / "export" / "splats.spz" / "deep" / "b.txt").write_text("mine")
    (tmp_path / "export" / "images").write_text("mine too")
    commit(tmp_path, "export.spz", {"splats.spz": "new"})
    commit(tmp_path, "export.colmap", {"images/a.png": "new", "sparse/0/images.bin": "new"})
    assert files_of(tmp_path) == {
        "splats.ply": b"new", "splats.spz": b"new", "splats.kept.spz/deep/b.txt": b"mine",
        "images.kept": b"mine too", "images/a.png": b"new", "sparse/0/images.bin": b"new"}


def test_files_left_of_a_format_that_is_written_again_are_not_kept(tmp_path):
    commit(tmp_path, "export", {"splats.ply": "old"})
    commit(tmp_path, "export.lod", dict.fromkeys(
        ("lod/lod-meta.json", "lod/0_0/meta.json", "lod/0_9/meta.json"), "old"))
    commit(tmp_path, "export.colmap", {
        "sparse/0/images.bin": "old", "images/a.png": "old", "images/gone.png": "old"})
    commit(tmp_path, "export.transforms.json", {
        "transforms.json": "old", "images/a.png": "old", "images/gone.png": "old"})
    # INRIA's reader wrote points3D.ply; beside another model it would be read in place of its own
    (tmp_path / "export" / "sparse" / "0" / "points3D.ply").write_text("foreign")
    commit(tmp_path, "export.lod", dict.fromkeys(("lod/lod-meta.json", "lod/0_0/meta.json"), "new"))
    for _ in range(2):
        commit(tmp_path, "export.colmap", {"sparse/0/images.bin": "new", "images/a.png": "new"})
    assert files_of(tmp_path) == {
        "splats.ply": b"old", "lod/lod-meta.json": b"new", "lod/0_0/meta.json": b"new",
        "images/a.png": b"new", "images/gone.png": b"old", "sparse/0/images.bin": b"new",
        "transforms.json": b"old", "sparse/0/points3D.kept.ply": b"foreign"}


def test_links_of_the_user_are_never_followed_when_files_are_removed(tmp_path):
    commit(tmp_path, "export", {"splats.ply": "new"})
    commit(tmp_path, "export.lod", {"lod/lod-meta.json": "old", "lod/0_0/meta.json": "old"})
    other = tmp_path / "elsewhere"
    (tmp_path / "export" / "lod").rename(other)
    (tmp_path / "export" / "lod").symlink_to(other)
    commit(tmp_path, "export.lod", {"lod/lod-meta.json": "new"})
    assert (other / "lod-meta.json").read_text() == (other / "0_0" / "meta.json").read_text() == (
        "old")
    assert (tmp_path / "export" / "lod.kept").is_symlink()
    assert (tmp_path / "export" / "lod" / "lod-meta.json").read_text() == "new"


def test_files_are_copied_where_the_folder_lies_on_another_disk(tmp_path, monkeypatch):
    real = durable.replace

    def refuse(source, target):
        if source.parent.name != target.parent.name:
            raise OSError(errno.EXDEV, "another disk")
        real(source, target)

    monkeypatch.setattr(durable, "replace", refuse)
    for text in ("old", "new"):
        commit(tmp_path, "export", {"splats.ply": text})
    assert files_of(tmp_path) == {"splats.ply": b"new"}
    assert (tmp_path / "export" / "manifest.json").is_file()


def test_each_format_has_files_of_its_own():
    paths = {"ply": "splats.ply", "spz": "splats.spz", "compressed.ply": "splats.compressed.ply",
             "lod": "lod/0_0/meta.json", "colmap": "sparse/0/images.bin", "plan.svg": "plan.svg",
             "transforms.json": "sparse_pc.ply", "mesh.glb": "mesh.glb", "points.ply": "points.ply"}

    def owners(path):
        return [row.name for row in EXPORT_FORMATS.values() if matches(path, row.patterns)]

    for name, path in paths.items():
        assert owners(path) == [name]
    assert set(owners("images/a.png")) == {"colmap", "transforms.json"}
