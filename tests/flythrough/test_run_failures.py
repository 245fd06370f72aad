"""`recon render` in process: what is missing, damaged or cannot be had, and kills."""

import errno
import os
import shutil

import pytest
from facts import assert_facts
from render_cli import SHORT, pictures, record, render

from recon_cli.flythrough import output
from recon_cli.flythrough import run as running
from recon_cli.io.images import read_image


def test_up_that_is_not_known_is_said(before_a_wall, tmp_path, caplog):
    assert render(before_a_wall, "--path", "orbit", *SHORT, "--out", tmp_path / "out") == 0
    assert_facts(caplog.text, "up", "known")


def test_without_a_trained_model_the_command_to_type_is_named(copied, capsys):
    shutil.rmtree(copied / "train")
    assert render(copied) == 4
    said = capsys.readouterr().err
    assert_facts(said, "render", "train", "missing")
    assert_facts(said, "recon train")
    assert not (copied / "render").exists()


def test_an_empty_workspace_names_the_first_command(tmp_path, capsys):
    assert render(tmp_path / "none") == 4
    assert_facts(capsys.readouterr().err, "recon ingest VIDEO -w")
    assert not (tmp_path / "none").exists()


def test_a_pruned_model_that_is_not_there_is_an_error_and_a_stale_one_is_left_out(
    copied, before_a_wall, tmp_path, capsys, caplog
):
    assert render(before_a_wall, "--model", "pruned", "--out", tmp_path / "out") == 4
    assert_facts(capsys.readouterr().err, "recon prune -w")
    (copied / "prune" / "splats.ply").write_bytes((copied / "train" / "splats.ply").read_bytes())
    assert render(copied, "--views", "000001", "--out", tmp_path / "out") == 0
    assert_facts(caplog.text, "model", "stale")
    assert record(tmp_path / "out")["settings"]["model"] == "base"


@pytest.mark.parametrize(("words", "said"), [
    (["--views", "000099"], "views is named '000099'"),
    (["--views", "000001.pgn"], "Did you mean 000001.png?"),
    (["--path", "orbit", "--views", "test"], "exclude each other"),
    (["--output", "rgb,normals"], "'rgb,normals' is not a list"),
    (["--background", "white"], "not a colour such as"),
    (["--size", "100000"], "MB to render"),
    (["--width", "321", "--format", "mp4"], "must be even"),
    (["--format", "mp4", "--width", "40000", "--height", "2"], "libx264 cannot encode"),
])
def test_what_cannot_be_rendered_is_a_usage_error(copied, capsys, words, said):
    assert render(copied, *words) == 2
    assert said in capsys.readouterr().err
    assert not (copied / "render").exists()


def test_a_codec_that_is_missing_is_said_before_anything_is_rendered(
    copied, monkeypatch, capsys
):
    monkeypatch.setitem(output.ENCODERS, "av1", ("libnone",))
    assert render(copied, "--format", "mp4", "--codec", "av1") == 2
    assert_facts(capsys.readouterr().err, "av1")
    assert not (copied / "render").exists()


def test_a_file_that_is_no_path_is_an_input_error(room, tmp_path, capsys):
    (tmp_path / "path.json").write_text('{"camera_path": []}')
    assert render(room, "--path", tmp_path / "path.json", "--out", tmp_path / "out") == 3
    assert_facts(capsys.readouterr().err, "lists", "cameras")


def test_a_folder_of_other_files_is_left_alone(room, tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.jpg").write_text("a photo")
    assert render(room, *SHORT, "--out", tmp_path / "photos") == 7
    assert_facts(capsys.readouterr().err, "photos", "me.jpg")
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["me.jpg"]


def test_a_folder_that_cannot_be_made_is_an_error(room, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert render(room, *SHORT, "--out", tmp_path / "file" / "out") == 7
    assert_facts(capsys.readouterr().err, "error:", tmp_path / "file" / "out")


@pytest.mark.parametrize(("number", "said"), [
    (errno.ENOSPC, "disk is full"), (errno.EROFS, "not writable")])
def test_a_disk_that_takes_no_more_is_an_error_and_frames_stay(
    room, tmp_path, monkeypatch, capsys, number, said
):
    write, written = running.write_frame, []

    def failing(*given):
        if written:
            raise OSError(number, os.strerror(number))
        written.append(1)
        write(*given)

    words = [*SHORT, "--out", tmp_path / "out"]
    with monkeypatch.context() as patch:
        patch.setattr(running, "write_frame", failing)
        assert render(room, *words) == 7
    assert said in capsys.readouterr().err
    assert pictures(tmp_path / "out") == ["00000.png"]
    assert render(room, *words) == 0


def test_a_damaged_record_is_refused(room, tmp_path, capsys):
    words = [*SHORT, "--out", tmp_path / "out"]
    assert render(room, *words) == 0
    (tmp_path / "out" / "render.json").write_text("[]")
    assert render(room, *words) == 3
    assert_facts(capsys.readouterr().err, "recon render")


def test_a_kill_between_old_frames_and_new_ones_leaves_a_folder_that_goes_on(
    room, tmp_path, monkeypatch
):
    class Killed(BaseException):
        pass

    def die(*_given):
        raise Killed

    words = [*SHORT, "--out", tmp_path / "out"]
    for _ in ("a new folder", "one with frames of other settings"):
        with monkeypatch.context() as patch:
            patch.setattr(running, "write_json", die)
            with pytest.raises(Killed):
                render(room, *words, "--size", "40")
        assert render(room, *words) == 0
        assert pictures(tmp_path / "out") == [f"{number:05d}.png" for number in range(4)]
        assert read_image(tmp_path / "out" / "rgb" / "00000.png", 48, 36).any()
        assert record(tmp_path / "out")["settings"]["sizes"] == [[48, 36]]
