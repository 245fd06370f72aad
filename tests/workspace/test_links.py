"""Nothing outside the workspace is deleted, whatever a link or a manifest points to."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from facts import raises

from recon_cli.errors import ManifestError
from recon_cli.workspace import layout
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.digests import digest_outputs, sha256_json
from recon_cli.workspace.layout import Workspace, has_link, move, remove, size_of
from recon_cli.workspace.manifest import Manifest, ResultKey, RunRecord

RUN = RunRecord(1.0, 2, {}, {}, None, None, 1, "2020-01-01T00:00:00+00:00")
KEY = ResultKey("train", 1, {"iterations": 1}, (), {"place": "abc"})


def finish(workspace: Workspace, text: str) -> None:
    """Writes and commits one result of train."""
    with workspace.writing("train"):
        out, _ = workspace.begin(KEY)
        write_bytes(out / "data.txt", text.encode())
        outputs = workspace.seal("train")
        workspace.commit(Manifest(KEY, outputs, digest_outputs(outputs, ()), RUN))


def content(workspace: Workspace) -> str:
    return (workspace.folder("train") / "data.txt").read_text()


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "ws")


@pytest.fixture
def thesis(tmp_path: Path) -> Path:
    """A folder of the user's, with folders that are called like stages."""
    for name in ("train", "ingest"):
        (tmp_path / "mine" / name).mkdir(parents=True)
        (tmp_path / "mine" / name / "thesis.txt").write_text("years of work")
    return tmp_path / "mine"


def untouched(thesis: Path) -> bool:
    return all((thesis / name / "thesis.txt").read_text() == "years of work"
               for name in ("train", "ingest"))


def rewrite(path: Path, change: Callable[[dict[str, object]], object]) -> None:
    """Changes a manifest and signs it again."""
    value = json.loads(path.read_text())
    value.pop("self")
    change(value)
    path.write_text(json.dumps({**value, "self": sha256_json(value)}))


@pytest.mark.parametrize("name", [
    "../thesis.txt", "model/../../thesis.txt", "/etc/passwd", "", ".", "a//b", "a/./b", "a\0b",
    "C:\\thesis", "C:/thesis", "a\\..\\b", "a" * 300, "é" * 128])
def test_a_manifest_that_names_files_elsewhere_is_refused(
    workspace: Workspace, name: str
) -> None:
    finish(workspace, "one")
    file = {"sha256": "0", "size": 1, "mtime_ns": 1}
    rewrite(workspace.folder("train") / "manifest.json",
            lambda value: value["outputs"].update({name: file}))  # type: ignore[attr-defined]
    with raises(ManifestError, "file", "stage") as caught:
        workspace.manifest("train")
    assert "recon clean train" in caught.value.hint


@pytest.mark.parametrize(("key", "value"), [
    ("outputs", []), ("outputs", {"a": 1}), ("outputs", {"a": {"sha256": 1}}), ("inputs", 3),
    ("inputs", [{}]), ("config", None), ("upstream", {"sfm": 5}), ("upstream", []),
    ("stage", ["train"]), ("version", "1"), ("seconds", None), ("summary", []), ("digest", 1),
    ("versions", "x"), ("continues", 3)])
def test_a_signed_manifest_with_values_of_other_types_is_refused(
    workspace: Workspace, key: str, value: object
) -> None:
    finish(workspace, "one")
    path = workspace.folder("train") / "manifest.json"
    rewrite(path, lambda content: content.update({key: value}))
    with raises(ManifestError, "manifest"):
        workspace.manifest("train")
    rewrite(path, lambda content: content.pop(key))
    if key != "continues":
        with raises(ManifestError, "lacks"):
            workspace.manifest("train")


def test_a_link_is_removed_and_measured_by_itself(thesis: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(thesis)
    assert size_of(link) == link.lstat().st_size
    remove(link)
    assert not link.is_symlink()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "inner").symlink_to(thesis)
    remove(tmp_path / "folder")
    assert untouched(thesis)


def test_a_file_behind_a_link_is_told_from_others(thesis: Path, tmp_path: Path) -> None:
    (tmp_path / "ws").mkdir()
    (tmp_path / "ws" / "sfm").symlink_to(thesis)
    assert has_link(tmp_path / "ws" / "sfm" / "train" / "thesis.txt", tmp_path / "ws")
    assert not has_link(thesis / "train" / "thesis.txt", tmp_path)


@pytest.mark.parametrize("name", [".partial", ".old", "blocks", "seeds"])
def test_a_linked_folder_of_scraps_is_unlinked_and_not_emptied(
    workspace: Workspace, thesis: Path, name: str
) -> None:
    workspace.root.mkdir()
    (workspace.root / name).symlink_to(thesis)
    assert workspace.scraps() == [workspace.root / name]
    for path in workspace.scraps():
        remove(path)
    (workspace.root / name).symlink_to(thesis)
    finish(workspace, "one")
    finish(workspace, "two")
    assert content(workspace) == "two"
    assert untouched(thesis)


def test_a_link_in_the_place_of_unfinished_work_is_not_followed(
    workspace: Workspace, thesis: Path
) -> None:
    with workspace.writing("train"):
        out, _ = workspace.begin(KEY)
    out.rmdir()
    out.symlink_to(thesis / "train")
    finish(workspace, "one")
    assert not workspace.folder("train").is_symlink()
    assert untouched(thesis)


@pytest.mark.parametrize("relative", [True, False])
def test_a_result_that_was_moved_and_linked_is_replaced_and_kept_where_it_is(
    workspace: Workspace, tmp_path: Path, relative: bool
) -> None:
    finish(workspace, "one")
    large = tmp_path / "large" / "train"
    large.parent.mkdir()
    workspace.folder("train").rename(large)
    workspace.folder("train").symlink_to(Path("../large/train") if relative else large)
    assert workspace.manifest("train") is not None
    finish(workspace, "two")
    assert content(workspace) == "two"
    assert (large / "data.txt").read_text() == "one"
    assert workspace.scraps() == []


def test_a_crash_while_a_linked_result_is_replaced_leaves_the_old_one(
    workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish(workspace, "one")
    (tmp_path / "large").mkdir()
    workspace.folder("train").rename(tmp_path / "large" / "train")
    workspace.folder("train").symlink_to("../large/train")

    class Killed(BaseException):
        pass

    def die(*_: Path) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(layout, "move", die)
        with pytest.raises(Killed):
            finish(workspace, "two")
    with workspace.writing("status"):
        pass
    assert content(workspace) in ("one", "two")


@pytest.mark.parametrize("target", ["unplugged/train", "train"])
def test_a_link_that_leads_nowhere_is_replaced(workspace: Workspace, target: str) -> None:
    workspace.root.mkdir()
    workspace.folder("train").symlink_to(target)
    finish(workspace, "one")
    assert content(workspace) == "one"


def test_a_linked_workspace_and_work_on_another_disk_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "scratch").mkdir()
    (tmp_path / "ws").symlink_to(tmp_path / "real")
    workspace = Workspace(tmp_path / "ws")
    (workspace.root / ".partial").symlink_to(tmp_path / "scratch")
    with workspace.writing("train"):
        out, _ = workspace.begin(KEY)
        assert not (workspace.root / ".partial").is_symlink() or not any(
            (tmp_path / "scratch").iterdir()) or out.is_dir()
    rename = os.rename

    def across(self: Path, target: Path) -> Path:
        if ".partial" in self.parts and ".partial" not in Path(target).parts:
            raise OSError(18, "Invalid cross-device link")
        rename(self, target)
        return Path(target)

    monkeypatch.setattr(Path, "rename", across)
    finish(workspace, "one")
    assert content(workspace) == "one"
    assert workspace.scraps() == [] or (workspace.root / ".partial").is_symlink()


def test_a_folder_that_cannot_be_renamed_to_another_disk_is_copied_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "sub").mkdir(parents=True)
    (source / "sub" / "a").write_text("1")
    (source / "link").symlink_to("nowhere")
    (tmp_path / ".target.moving").mkdir()  # of a move that was killed
    rename = os.rename

    def across(self: Path, to: Path) -> Path:
        if self == source:
            raise OSError(18, "Invalid cross-device link")
        rename(self, to)
        return Path(to)

    monkeypatch.setattr(Path, "rename", across)
    move(source, target)
    assert (target / "sub" / "a").read_text() == "1"
    assert os.readlink(target / "link") == "nowhere"
    assert not source.exists()
    assert not (tmp_path / ".target.moving").exists()


def test_a_link_in_unfinished_work_is_not_followed(workspace: Workspace, thesis: Path) -> None:
    with workspace.writing("train"):
        out, first = workspace.begin(KEY, own_digests=True)
        (out / "model").symlink_to(thesis)
        again, earlier = workspace.begin(KEY, own_digests=True)
        assert earlier == first
        assert list(again.iterdir()) == []
    assert untouched(thesis)
