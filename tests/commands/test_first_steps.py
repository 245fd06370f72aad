"""What a first user types: a file in place of a verb, a verb without a file, options of others."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from facts import assert_facts, raises

import recon_cli
from recon_cli.cli import main
from recon_cli.commands import budget
from recon_cli.commands.budget import Budget
from recon_cli.commands.options import Call
from recon_cli.errors import ConfigError, ReconError
from recon_cli.workspace.layout import Workspace


def said(capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """The error and the hint of the last command."""
    lines = capsys.readouterr().err.splitlines()
    return tuple(next(line for line in lines if line.startswith(word))  # type: ignore[return-value]
                 for word in ("error: ", "hint: "))


def test_a_capture_in_place_of_a_verb_is_answered_by_the_command_for_it(capsys):
    assert main(["my room.mp4"]) == 2
    assert "`recon run 'my room.mp4'`" in said(capsys)[1]


def test_a_folder_in_place_of_a_verb_is_too(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    assert main(["photos"]) == 2
    assert "`recon run photos`" in said(capsys)[1]


@pytest.mark.parametrize(("words", "code", "typed"), [
    (["train", "room.mp4"], 2, "`recon run room.mp4`"),
    (["sfm", "room.mp4"], 2, "`recon ingest room.mp4`"),
    (["sfm", "a/1.jpg", "a/2.jpg", "a/3.jpg", "a/4.jpg"], 2, "`recon run a`"),
    (["render", "scene.spz"], 2, "`recon import scene.spz`, then `recon render`"),
    (["status", "done"], 2, "`recon status -w done`"),
    (["clean", "--dry-run", "train", "-w", "none"], 0, ""),
    (["eval", "photos"], 3, "`recon run photos`"),
    (["view", "photos"], 3, "`recon run photos`"),
    (["view"], 4, "`recon run VIDEO`"),
    (["run", "https://a.org/room.mp4"], 2, "`recon run room.mp4`"),
    (["export", "https://a.org/room.mp4"], 2, "`recon run room.mp4`"),
    (["https://a.org/b"], 2, "`recon run b`"),
    (["info", "https://a.org/b.ply"], 2, "`recon info b.ply`"),
    (["train", "3000"], 2, "`recon train --help`"),
])
def test_what_a_verb_does_not_take_is_answered_by_the_command_that_does(
        capsys, tmp_path, monkeypatch, words, code, typed):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)
    Path("photos").mkdir()
    Path("done/ingest").mkdir(parents=True)
    Path("done/ingest/manifest.json").touch()
    assert main(words) == code
    assert typed in capsys.readouterr().err
    assert not Path("workspace").exists()


def test_an_address_is_refused_from_python_as_well(tmp_path):
    with raises(ConfigError, "https://a.org/room.mp4"):
        recon_cli.Workspace(tmp_path / "ws").ingest("https://a.org/room.mp4")
    assert not (tmp_path / "ws").exists()


@pytest.mark.integration
def test_view_says_what_it_opens_before_it_imports_what_draws(tmp_path):
    scene = tmp_path / "scene.ply"
    scene.write_bytes(b"ply")
    code = f"""
import logging, sys
from recon_cli.cli import main
class Early(logging.Handler):
    def emit(self, record):
        assert not {{"torch", "viser", "numba"}} & set(sys.modules)
        assert {str(scene)!r} in record.getMessage()
        sys.exit(77)
logging.getLogger("recon").addHandler(Early(logging.INFO))
main(["view", {str(scene)!r}])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 77, done.stderr


def test_a_misspelt_verb_is_not_taken_for_a_capture(capsys):
    assert main(["trian"]) == 2
    assert "train" in said(capsys)[0]


@pytest.mark.parametrize(("verb", "typed"), [("run", "run VIDEO"), ("ingest", "ingest VIDEO")])
def test_without_an_input_the_command_to_type_is_said_and_nothing_is_left(
        capsys, tmp_path, verb, typed):
    folder = tmp_path / "ws"
    assert main([verb, "-w", str(folder)]) == 2
    assert f"`recon {typed}" in said(capsys)[1]
    assert not folder.exists()


def test_a_first_command_that_fails_leaves_no_folder_but_a_later_one_keeps_it(tmp_path):
    folder = tmp_path / "ws"
    assert main(["run", str(tmp_path / "missing.mp4"), "-w", str(folder)]) == 3
    assert not folder.exists()
    folder.mkdir()
    assert main(["run", str(tmp_path / "missing.mp4"), "-w", str(folder)]) == 3
    assert folder.exists()


def test_a_capture_that_is_refused_after_it_was_read_leaves_nothing_but_its_parents(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "there").mkdir()
    folder = tmp_path / "there" / "a" / "b"
    assert main(["run", str(tmp_path / "photos"), "-w", str(folder)]) == 3
    assert not list((tmp_path / "there").iterdir())


def test_an_interruption_keeps_a_new_folder_only_with_work_in_it(tmp_path):
    for name, work in (("empty", False), ("begun", True)):
        workspace = Workspace(tmp_path / name)

        def interrupt(workspace: Workspace = workspace, work: bool = work) -> None:
            with workspace.writing("run"):
                workspace.partial("ingest").mkdir(parents=True)
                if not work:
                    workspace.partial("ingest").rmdir()
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupt()
        assert workspace.root.exists() is work


def test_a_folder_with_a_file_of_the_user_in_it_is_never_removed(tmp_path):
    workspace = Workspace(tmp_path / "ws")

    def fail() -> None:
        with workspace.writing("run"):
            (workspace.root / "mine.txt").touch()
            raise ReconError("no")

    with pytest.raises(ReconError):
        fail()
    assert (workspace.root / "mine.txt").exists()


def test_an_option_of_a_stage_is_answered_by_its_set(capsys):
    assert main(["run", "x", "--iterations", "5"]) == 2
    assert "--set train.iterations=VALUE" in said(capsys)[1]
    assert main(["run", "x", "--seed", "5"]) == 2
    assert_facts(said(capsys)[1], "--set", "sfm.seed=VALUE", "train.seed=VALUE")


def test_run_takes_the_options_that_first_users_look_for(capsys, tmp_path):
    assert main(["run", "--print-config", "--quality", "draft", "--frames", "40", "--title", "Us",
                 "-w", str(tmp_path / "ws")]) == 0
    printed = capsys.readouterr().out
    assert 'quality = "draft"' in printed
    assert "frames = 40" in printed
    assert 'title = "Us"' in printed
    assert 'format = "html"' in printed


def test_a_time_and_a_number_of_steps_are_refused_before_anything_runs(tmp_path, capsys):
    folder = tmp_path / "ws"
    assert main(["run", "x.mp4", "--minutes", "2", "--set", "train.iterations=5", "-w",
                 str(folder)]) == 2
    assert "minutes" in said(capsys)[0]
    assert not folder.exists()


def test_choices_for_a_time_are_kept_for_the_same_time_and_input(tmp_path):
    call = Call(workspace=tmp_path)
    video = tmp_path / "a.mp4"
    chosen = Budget(minutes=5.0, inputs=(str(video),), max_frames=40, train_minutes=1.5, prune=True)
    (tmp_path / budget.FILE).write_text(json.dumps(chosen.to_json()))
    assert budget._recorded(call, 5.0, (video,)) == chosen
    assert budget._recorded(call, 5.0, ()) == chosen
    assert budget._recorded(call, 6.0, (video,)) is None
    assert budget._recorded(call, 5.0, (tmp_path / "b.mp4",)) is None
    call.again = True
    assert budget._recorded(call, 5.0, (video,)) is None
