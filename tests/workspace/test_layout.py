"""Results are whole: after a crash at any step, after damage, with two writers, on a full disk."""

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from facts import assert_facts, raises

from recon_cli.errors import InputError, ManifestError, WorkspaceError
from recon_cli.workspace import layout
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.digests import digest_file, digest_outputs, read_source
from recon_cli.workspace.layout import Workspace, disk_errors
from recon_cli.workspace.manifest import (
    Manifest,
    ResultKey,
    RunRecord,
    differences,
    find_changed_outputs,
    version_differences,
)

RUN = RunRecord(1.0, 2, {}, {}, None, None, 1, "2020-01-01T00:00:00+00:00")


class Killed(BaseException):
    """Stands for the end of the process."""


def key(config: int = 1) -> ResultKey:
    return ResultKey("train", 1, {"iterations": config}, (), {"place": "abc"})


def finish(workspace: Workspace, text: str, config: int = 1) -> Manifest:
    """Writes and commits one result."""
    out, _ = workspace.begin(key(config))
    (out / "sub").mkdir(exist_ok=True)
    (out / "sub" / "data.txt").write_text(text)
    outputs = workspace.seal("train")
    manifest = Manifest(key(config), outputs, digest_outputs(outputs, ()), RUN)
    workspace.commit(manifest)
    return manifest


def content(workspace: Workspace) -> str:
    return (workspace.folder("train") / "sub" / "data.txt").read_text()


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "ws")


def test_a_committed_result_is_read_back_as_it_was_written(workspace: Workspace) -> None:
    with workspace.writing("train"):
        written = finish(workspace, "one")
    assert workspace.manifest("train") == written
    assert list(written.outputs) == ["sub/data.txt"]
    assert workspace.partial_run("train") is None
    assert workspace.scraps() == []


def test_the_fingerprint_ignores_names_and_times_of_inputs_but_not_their_order(
    tmp_path: Path,
) -> None:
    one, two, three = (tmp_path / name for name in ("a", "b", "c"))
    one.write_text("x")
    two.write_text("x")
    three.write_text("y")
    os.utime(two, ns=(1, 1))

    def fingerprint(*paths: Path) -> str:
        sources = tuple(read_source(path, without=tmp_path / "ws") for path in paths)
        return ResultKey("ingest", 1, {}, sources, {}).fingerprint

    assert fingerprint(one) == fingerprint(two)
    assert fingerprint(one, three) != fingerprint(three, one)


def test_a_folder_is_read_without_hidden_files_and_without_the_workspace(tmp_path: Path) -> None:
    for name in ("b.jpg", "sub/a.jpg", ".hidden", ".git/x", "ws/ingest/frame.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    assert list(read_source(tmp_path, without=tmp_path / "ws").files) == ["b.jpg", "sub/a.jpg"]


def test_a_missing_input_is_an_input_error(tmp_path: Path) -> None:
    with raises(InputError):
        read_source(tmp_path / "none.mp4", without=tmp_path)


def test_a_known_digest_is_believed_while_size_and_time_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("one")
    known = digest_file(path)
    path.write_text("two")
    os.utime(path, ns=(known.mtime_ns, known.mtime_ns))
    assert digest_file(path, known) == known
    os.utime(path, ns=(known.mtime_ns + 1, known.mtime_ns + 1))
    assert digest_file(path, known).sha256 != known.sha256


def test_a_renamed_photo_is_named_among_the_reasons(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "a.jpg").write_text("1")
    (tmp_path / "p" / "b.jpg").write_text("2")
    before = ResultKey("ingest", 1, {}, (read_source(tmp_path / "p", without=tmp_path),), {})
    (tmp_path / "p" / "a.jpg").rename(tmp_path / "p" / "c.jpg")
    (tmp_path / "p" / "b.jpg").write_text("changed")
    after = ResultKey("ingest", 1, {}, (read_source(tmp_path / "p", without=tmp_path),), {})
    for reason, name, change in zip(differences(before, after, section="ingest"), "abc",
                                    ("gone", "changed", "new"), strict=True):
        assert_facts(reason, f"p/{name}.jpg", change)


def test_options_that_another_version_knew_or_did_not_know_are_named() -> None:
    before = ResultKey("export", 1, {"gone": None, "kept": 1.5}, (), {})
    after = ResultKey("export", 1, {"kept": 2.0, "crop": None}, (), {})
    (reason,) = differences(before, after, section="export")
    assert_facts(reason, "export.kept", 1.5, 2)
    new, gone = version_differences(before, after, section="export")
    assert_facts(new, "export.crop", "new")
    assert_facts(gone, "export.gone")


def test_outputs_changed_by_hand_or_missing_are_named(workspace: Workspace) -> None:
    with workspace.writing("train"):
        manifest = finish(workspace, "one")
    data = workspace.folder("train") / "sub" / "data.txt"
    os.utime(data, ns=(5, 5))
    assert find_changed_outputs(workspace.folder("train"), manifest, ()) == []
    data.write_text("edited")
    (reason,) = find_changed_outputs(workspace.folder("train"), manifest, ())
    assert_facts(reason, "sub/data.txt", "hand")
    data.unlink()
    (reason,) = find_changed_outputs(workspace.folder("train"), manifest, ())
    assert_facts(reason, "sub/data.txt", "missing")
    assert find_changed_outputs(workspace.folder("train"), manifest, ("sub/*",)) == []


@pytest.mark.parametrize("damage", ["truncated", "edited", "unsigned", "other schema", "a list"])
def test_a_manifest_that_cannot_be_trusted_names_the_file_and_the_remedy(
    workspace: Workspace, damage: str
) -> None:
    with workspace.writing("train"):
        finish(workspace, "one")
    path = workspace.folder("train") / "manifest.json"
    text, value = path.read_text(), json.loads(path.read_text())
    path.write_text({
        "truncated": text[: len(text) // 2],
        "edited": text.replace('"iterations": 1', '"iterations": 2'),
        "unsigned": json.dumps({key: value[key] for key in value if key != "self"}),
        "other schema": json.dumps({**value, "schema": "99"}),
        "a list": "[]",
    }[damage])
    with pytest.raises(ManifestError) as caught:
        workspace.manifest("train")
    assert caught.value.exit_code == 7
    assert str(path) in caught.value.message
    assert f"recon clean train -w {workspace.root}" in caught.value.hint


def test_a_manifest_of_a_newer_schema_asks_for_an_update_and_for_nothing_to_be_deleted(
    workspace: Workspace
) -> None:
    with workspace.writing("train"):
        finish(workspace, "one")
    path = workspace.folder("train") / "manifest.json"
    value = json.loads(path.read_text())
    path.write_text(json.dumps({**value, "schema": 2}))
    with raises(ManifestError, 2, "schema") as caught:
        workspace.manifest("train")
    assert "pdate recon" in caught.value.hint
    assert "`" not in caught.value.hint


def test_the_hint_of_a_damaged_manifest_names_the_scene_beside_it(workspace: Workspace) -> None:
    with workspace.writing("train"):
        finish(workspace, "one")
    (workspace.folder("train") / "splats.ply").write_text("a scene")
    (workspace.folder("train") / "manifest.json").write_text("{}")
    with pytest.raises(ManifestError) as caught:
        workspace.manifest("train")
    hint = caught.value.hint
    assert 0 <= hint.index(str(workspace.folder("train") / "splats.ply")) < hint.index("clean")


def test_a_result_that_may_not_be_looked_at_is_not_missing(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    with workspace.writing("train"):
        finish(workspace, "one")
    real = os.lstat

    def deny(path: str | Path) -> os.stat_result:
        if Path(path).parent == workspace.folder("train"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(os, "lstat", deny)
    with raises(WorkspaceError, "Permission", "denied"), disk_errors(
            workspace.root, "reading"):
        workspace.manifest("train")


def test_a_crash_at_any_rename_leaves_the_old_or_the_new_result_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = {"rename": os.rename, "replace": os.replace, "rmtree": shutil.rmtree}
    crashes = 0
    for step in range(1, 100):
        workspace = Workspace(tmp_path / str(step))
        with workspace.writing("train"):
            finish(workspace, "old", config=1)
            out, _ = workspace.begin(key(2))
            (out / "sub").mkdir()
            (out / "sub" / "data.txt").write_text("new")
        calls = 0

        def counted(name: str, *args: object, **options: object) -> object:
            nonlocal calls
            calls += 1
            if calls == step:  # noqa: B023
                raise Killed(name)
            return real[name](*args, **options)

        with monkeypatch.context() as patch:
            for module, name in ((os, "rename"), (os, "replace"), (shutil, "rmtree")):
                patch.setattr(
                    module, name, lambda *a, _name=name, **k: counted(_name, *a, **k))
            try:
                outputs = workspace.seal("train")
                workspace.commit(Manifest(key(2), outputs, digest_outputs(outputs, ()), RUN))
            except Killed:
                crashes += 1
        if calls < step:
            break
        with workspace.writing("train"):  # the next writer mends
            manifest = workspace.manifest("train")
            assert manifest is not None
            assert find_changed_outputs(workspace.folder("train"), manifest, ()) == []
            # Only without its manifest, which the first step puts in place, is the new one lost.
            assert content(workspace) == ("old" if step == 1 else "new")
            assert manifest.key == key(1 if step == 1 else 2)
            assert list((workspace.root / ".old").glob("*")) == []
            finish(workspace, "newer", config=3)
        assert content(workspace) == "newer"
    assert crashes == 4  # manifest in place, old away, new in place, old removed


def test_a_crash_while_mending_loses_nothing(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    with workspace.writing("train"):
        finish(workspace, "old")
        (workspace.root / ".old").mkdir()
        workspace.folder("train").rename(workspace.root / ".old" / "train")

    def killed(*_args: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", killed)
        with pytest.raises(Killed), workspace.writing("train"):
            pass
    with workspace.writing("train"):
        assert content(workspace) == "old"


def test_a_partial_folder_counts_only_for_the_same_basis(workspace: Workspace) -> None:
    with workspace.writing("train"):
        out, _ = workspace.begin(key(1))
        write_bytes(out / "kept.txt", b"x")
        (out / ".kept.txt.tmp123.txt").write_text("half")
        same, earlier = workspace.begin(key(1))
        assert [path.name for path in same.iterdir()] == ["kept.txt"]
        assert earlier.key.fingerprint == key(1).fingerprint
        other, _ = workspace.begin(key(2))
        assert list(other.iterdir()) == []


def test_a_partial_folder_without_its_record_is_discarded(workspace: Workspace) -> None:
    with workspace.writing("train"):
        out, _ = workspace.begin(key(1))
        (out / "unknown.txt").write_text("x")
        (workspace.root / ".partial" / "train.json").write_text("{")
        again, _ = workspace.begin(key(1))
        assert list(again.iterdir()) == []


def test_a_folder_that_recon_did_not_make_is_not_replaced(workspace: Workspace) -> None:
    (workspace.root / "train").mkdir(parents=True)
    (workspace.root / "train" / "thesis.txt").write_text("years of work")
    with workspace.writing("train"):
        with raises(WorkspaceError):
            workspace.begin(key())
        with raises(WorkspaceError):
            workspace.remove("train")
    assert (workspace.root / "train" / "thesis.txt").exists()


def test_the_second_writer_is_told_who_the_first_is(workspace: Workspace) -> None:
    first = workspace.writing("train --prune")
    with first, pytest.raises(WorkspaceError) as caught, layout.hold_lock(workspace.root, "sfm"):
        pass
    assert f"process {os.getpid()}" in caught.value.message
    assert "recon train --prune" in caught.value.message


def test_what_a_dead_holder_left_does_not_lock(workspace: Workspace) -> None:
    workspace.root.mkdir()
    (workspace.root / layout.LOCK).touch()
    (workspace.root / layout.HOLDER).write_text('{"pid": 1}')
    with workspace.writing("train"):
        assert json.loads((workspace.root / layout.HOLDER).read_text())["pid"] == os.getpid()
    assert not (workspace.root / layout.HOLDER).exists()


@pytest.mark.parametrize("make", [
    Path.mkdir, os.mkfifo, lambda path: path.symlink_to(path.name),
    lambda path: path.symlink_to("thesis.txt")])
def test_a_lock_that_is_no_plain_file_is_said_and_left_alone(
    workspace: Workspace, make: Callable[[Path], object]
) -> None:
    workspace.root.mkdir()
    (workspace.root / "thesis.txt").write_text("years of work")
    make(workspace.root / layout.LOCK)
    with raises(WorkspaceError, "plain", "file"), workspace.writing("train"):
        pass
    assert (workspace.root / "thesis.txt").read_text() == "years of work"
    assert os.path.lexists(workspace.root / layout.LOCK)


@pytest.mark.parametrize("make", [
    Path.mkdir, os.mkfifo, lambda path: path.symlink_to("thesis.txt")])
def test_whatever_has_the_name_of_the_holder_makes_way(
    workspace: Workspace, make: Callable[[Path], object]
) -> None:
    workspace.root.mkdir()
    (workspace.root / "thesis.txt").write_text("years of work")
    make(workspace.root / layout.HOLDER)
    with workspace.writing("train"):
        assert json.loads((workspace.root / layout.HOLDER).read_text())["pid"] == os.getpid()
    assert (workspace.root / "thesis.txt").read_text() == "years of work"


def test_no_temporary_file_is_made_that_a_kill_would_leave_beside_the_lock(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "replace", lambda *_: pytest.fail("a temporary file"))
    with workspace.writing("train"):
        assert {path.name for path in workspace.root.iterdir()} == {layout.LOCK, layout.HOLDER}


def test_what_a_killed_report_left_is_a_scrap(workspace: Workspace) -> None:
    workspace.root.mkdir()
    left = workspace.root / ".report.html.tmp123.html"
    left.touch()
    assert workspace.scraps() == [left]


def test_a_full_disk_is_said_with_the_space_left(tmp_path: Path) -> None:
    with (raises(WorkspaceError, "disk", "running train", "MB"),
          disk_errors(tmp_path, "running train")):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_workspace_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    said = raises(WorkspaceError, "writable")
    with said, disk_errors(tmp_path, "running train"):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "train"))


def test_a_failure_elsewhere_on_disk_is_not_blamed_on_the_workspace(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), disk_errors(tmp_path / "ws", "running train"):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "video.mp4"))


def test_a_file_where_the_workspace_should_be_is_said(tmp_path: Path) -> None:
    (tmp_path / "ws").touch()
    writing = Workspace(tmp_path / "ws").writing("train")
    with raises(WorkspaceError, "made", "File"), writing:
        pass


def test_a_place_where_no_workspace_can_be_made_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *_args: object, **_options: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path.parent))

    monkeypatch.setattr(Path, "mkdir", refuse)
    writing = Workspace(tmp_path / "not" / "mine").writing("train")
    with raises(WorkspaceError, "Permission", "denied"), writing:
        pass


def test_a_result_that_was_damaged_before_its_last_rename_replaces_nothing(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with workspace.writing("train"):
        finish(workspace, "one")
    with monkeypatch.context() as patch:
        def die(*_: object) -> None:
            raise Killed

        patch.setattr(Workspace, "_swap", die)
        with pytest.raises(Killed), workspace.writing("train"):
            finish(workspace, "two")
    damaged = workspace.partial("train") / "sub" / "data.txt"
    damaged.unlink()
    damaged.mkdir()
    with workspace.writing("status"):
        assert content(workspace) == "one"
    assert not workspace.partial("train").exists()
    assert_facts(caplog.text, "sub/data.txt")


def test_a_manifest_that_is_a_link_to_nowhere_is_damaged_not_missing(workspace: Workspace) -> None:
    with workspace.writing("train"):
        finish(workspace, "one")
    manifest = workspace.folder("train") / "manifest.json"
    manifest.unlink()
    manifest.symlink_to("nowhere")
    with pytest.raises(ManifestError):
        workspace.manifest("train")
    with workspace.writing("train"):
        finish(workspace, "two")
    assert content(workspace) == "two"


@pytest.mark.integration
def test_only_leftovers_of_processes_that_are_gone_are_scraps(workspace: Workspace) -> None:
    workspace.root.mkdir()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    left, in_use = (
        workspace.root / f".report.html.tmp{pid}.html" for pid in (gone.pid, os.getpid()))
    for path in (left, in_use):
        path.write_text("half a page")
    assert workspace.scraps() == [left]
