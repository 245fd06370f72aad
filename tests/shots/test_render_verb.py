"""`recon render` in process, on workspaces of known truth."""

import errno
import json
import os
import shutil

import av
import cv2
import numpy as np
import pytest
import torch
from made import make_workspace, wall
from scenes import random_splats

from recon_cli.cli import main
from recon_cli.io.images import read_image
from recon_cli.shots import frames
from recon_cli.shots import run as running
from recon_cli.shots import video as videos

SHORT = ["--fps", "4", "--seconds", "1"]


def splats(seed):
    made = random_splats(60, seed=seed, dtype=torch.float32)
    made.means[:, 2] = 3 + 0.3 * made.means[:, 2]
    return made


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A workspace with a base and a pruned model, whose units are metres; nobody writes in it."""
    return make_workspace(
        tmp_path_factory.mktemp("room"), splats(1), pruned=splats(2), metres=True)


@pytest.fixture(scope="module")
def before_a_wall(tmp_path_factory):
    """A workspace of unknown scale and up whose model is a wall at z = 4."""
    return make_workspace(
        tmp_path_factory.mktemp("wall"), wall(4.0, spacing=0.15), up_found=False)


@pytest.fixture
def copied(room, tmp_path):
    """A workspace of one's own."""
    return shutil.copytree(room, tmp_path / "ws")


def render(workspace, *words):
    return main(["render", "-w", str(workspace), "--threads", "1", *map(str, words)])


def pictures(folder, kind="rgb"):
    return sorted(path.name for path in (folder / kind).iterdir())


def times(folder):
    return {path.name: path.stat().st_mtime_ns for path in (folder / "rgb").iterdir()}


def record(folder):
    return json.loads((folder / "render.json").read_text())


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_view_is_to_the_bit_what_eval_renders(copied, tmp_path, backend):
    assert main(["eval", "-w", str(copied), "--backend", backend, "--threads", "1"]) == 0
    for model in ("base", "pruned"):
        out = tmp_path / model
        assert render(
            copied, "--views", "test", "--model", model, "--backend", backend, "--out", out) == 0
        expected = copied / "evaluate" / "renders" / model
        assert pictures(out) == ["000000.png", "000004.png", "000008.png"]
        for name in pictures(out):
            np.testing.assert_array_equal(
                read_image(out / "rgb" / name, 48, 36), read_image(expected / name, 48, 36))


def test_the_model_is_the_pruned_one_unless_asked_otherwise(room, tmp_path):
    seen = {}
    for model in ("auto", "base", "pruned"):
        assert render(room, "--views", "000001", "--model", model, "--out", tmp_path / model) == 0
        seen[model] = (tmp_path / model / "rgb" / "000001.png").read_bytes()
    assert seen["auto"] == seen["pruned"] != seen["base"]
    assert record(tmp_path / "auto")["settings"]["model"] == "pruned"


@pytest.mark.parametrize("path", ["training", "orbit"])
def test_a_path_is_written_as_a_file_that_gives_the_same_frames(room, tmp_path, path):
    first, second = tmp_path / "first", tmp_path / "second"
    options = ["--output", "rgb,depth,alpha", "--out"]
    assert render(room, "--path", path, *SHORT, *options, first) == 0
    assert render(room, "--path", first / "camera_path.json", *options, second) == 0
    assert pictures(first) == [f"{number:05d}.png" for number in range(4)]
    for kind in ("rgb", "depth", "depth_color", "alpha"):
        for name in pictures(first, kind):
            one, two = (cv2.imread(str(folder / kind / name), cv2.IMREAD_UNCHANGED)
                        for folder in (first, second))
            assert (one.shape[:2], one.dtype) == ((36, 48), two.dtype)
            # poses differ in the last bit
            assert np.abs(one.astype(int) - two).max() <= 1
    one, two = (json.loads((folder / "camera_path.json").read_text()) for folder in (first, second))
    np.testing.assert_allclose(*(
        [camera["camera_to_world"] for camera in path["camera_path"]] for path in (one, two)),
        rtol=0, atol=1e-14)
    assert {**one, "camera_path": []} == {**two, "camera_path": []}


def test_the_frames_lie_in_the_workspace_where_no_folder_is_given(copied):
    assert render(copied, *SHORT, "--output", "rgb,alpha") == 0
    assert render(copied, "--views", "test") == 0
    assert sorted(path.name for path in (copied / "render").iterdir()) == [
        "training-rgb-alpha", "views_test-rgb"]
    assert main(["status", "-w", str(copied)]) == 0


def test_views_are_named_by_parts_or_frames_and_keep_their_order(room, tmp_path):
    assert render(room, "--views", "000007.png", "--views", "test", "--views", "000002",
                  "--out", tmp_path / "out") == 0
    assert pictures(tmp_path / "out") == [
        f"{number:06d}.png" for number in (0, 2, 4, 7, 8)]
    assert not (tmp_path / "out" / "camera_path.json").exists()


def test_a_view_is_resized_as_a_whole(room, tmp_path):
    assert render(room, "--views", "000001", "--size", "96", "--out", tmp_path / "out") == 0
    large = cv2.imread(str(tmp_path / "out" / "rgb" / "000001.png"))
    assert large.shape == (72, 96, 3)
    assert render(room, "--views", "000001", "--out", tmp_path / "small") == 0
    small = cv2.imread(str(tmp_path / "small" / "rgb" / "000001.png"))
    reduced = cv2.resize(large, (48, 36), interpolation=cv2.INTER_AREA)
    assert np.abs(reduced.astype(int) - small).mean() < 4


def test_depth_is_in_thousandths_of_the_extent_where_the_scale_is_not_known(
    before_a_wall, tmp_path
):
    assert render(before_a_wall, "--views", "test", "--output", "depth",
                  "--out", tmp_path / "out") == 0
    said = record(tmp_path / "out")["settings"]["depth"]
    assert said["unit"] == "thousandth of the scene's extent"
    for number in (0, 4, 8):  # the camera of frame i stands at z = -i / 10
        steps = cv2.imread(str(tmp_path / "out" / "depth" / f"{number:06d}.png"),
                           cv2.IMREAD_UNCHANGED)
        assert steps.dtype == np.uint16
        np.testing.assert_allclose(
            steps * said["world_units_per_step"], 4 + number / 10,
            atol=0.51 * said["world_units_per_step"] + 1e-5)


def test_depth_is_in_millimetres_where_a_unit_is_a_metre(room, tmp_path):
    assert render(room, "--views", "test", "--output", "depth", "--out", tmp_path / "out") == 0
    said = record(tmp_path / "out")["settings"]["depth"]
    assert (said["unit"], said["world_units_per_step"]) == ("millimetre", 1e-3)


def test_the_background_is_seen_where_nothing_is(room, tmp_path):
    assert render(room, "--views", "000001", "--output", "rgb,alpha", "--background", "10,200,30",
                  "--out", tmp_path / "out") == 0
    rgb = read_image(tmp_path / "out" / "rgb" / "000001.png", 48, 36)
    alpha = cv2.imread(str(tmp_path / "out" / "alpha" / "000001.png"), cv2.IMREAD_UNCHANGED)
    assert alpha.shape == (36, 48)
    assert (alpha == 0).any()
    np.testing.assert_array_equal(rgb[alpha == 0], np.tile([10, 200, 30], ((alpha == 0).sum(), 1)))


def test_only_what_is_missing_is_rendered_again(room, tmp_path, capsys):
    words = ["--path", "orbit", *SHORT, "--output", "rgb,alpha", "--out", tmp_path / "out"]
    assert render(room, *words) == 0
    before = times(tmp_path / "out")
    content = (tmp_path / "out" / "rgb" / "00001.png").read_bytes()
    (tmp_path / "out" / "rgb" / "00001.png").unlink()
    (tmp_path / "out" / "alpha" / "00003.png").unlink()
    (tmp_path / "out" / "rgb" / ".00001.png.tmp99.png").write_text("half")
    capsys.readouterr()
    assert render(room, *words) == 0
    assert "2 of them rendered now" in capsys.readouterr().out
    after = times(tmp_path / "out")
    assert {name for name in after if after[name] != before[name]} == {"00001.png", "00003.png"}
    assert (tmp_path / "out" / "rgb" / "00001.png").read_bytes() == content
    assert pictures(tmp_path / "out", "alpha") == sorted(after)


@pytest.mark.parametrize(("change", "said"), [
    (["--size", "40"], "cameras, sizes"),
    (["--background", "1,2,3"], "background"),
    (["--model", "base"], "gaussians, model"),
    (["--output", "rgb,depth"], "depth, outputs"),
])
def test_other_settings_start_anew_and_are_named(room, tmp_path, caplog, change, said):
    words = ["--path", "orbit", *SHORT, "--output", "rgb,alpha", "--out", tmp_path / "out"]
    assert render(room, *words) == 0
    before = times(tmp_path / "out")
    assert render(room, *words, *change) == 0
    [said_so] = [text for text in caplog.messages if "starts anew" in text]
    assert said_so.endswith(f"for there are other settings: {said}")
    after = times(tmp_path / "out")
    assert not {name for name in after if after[name] == before[name]}
    assert pictures(tmp_path / "out", "alpha") == (
        [] if "--output" in change else sorted(after))


def test_fewer_frames_leave_none_of_the_old_ones(room, tmp_path):
    words = ["--path", "orbit", "--fps", "4", "--out", tmp_path / "out"]
    assert render(room, *words, "--seconds", "1") == 0
    assert render(room, *words, "--seconds", "0.5") == 0
    assert pictures(tmp_path / "out") == ["00000.png", "00001.png"]


def test_ctrl_c_leaves_the_finished_frames_and_exits_with_130(
    room, tmp_path, monkeypatch, capsys
):
    draw, drawn = running.render, []

    def interrupted(*given, **named):
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(1)
        return draw(*given, **named)

    words = ["--path", "orbit", *SHORT, "--format", "mp4", "--out", tmp_path / "out"]
    with monkeypatch.context() as patch:
        patch.setattr(running, "render", interrupted)
        assert render(room, *words) == 130
    assert "run the same command again" in capsys.readouterr().err
    assert pictures(tmp_path / "out") == ["00000.png", "00001.png"]
    assert not list(tmp_path.rglob("*.mp4"))
    assert render(room, *words) == 0
    assert "2 of them rendered now" in capsys.readouterr().out
    assert (tmp_path / "out" / "rgb.mp4").exists()


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_video_shows_the_frames_which_stay_beside_it(before_a_wall, tmp_path):
    out = tmp_path / "out"
    assert render(before_a_wall, *SHORT, "--size", "96", "--format", "mp4", "--crf", "8",
                  "--output", "rgb,depth,alpha", "--out", out) == 0
    for video, kind in (("rgb", "rgb"), ("depth", "depth_color"), ("alpha", "alpha")):
        frames = decoded(out / f"{video}.mp4")
        assert [frame.shape for frame in frames] == [(72, 96, 3)] * 4
        first = read_image(out / kind / "00000.png", 96, 72).astype(int)
        assert np.abs(frames[0] - first).mean() < 3


def test_a_file_gives_size_and_pace_unless_asked_otherwise(room, tmp_path):
    assert render(room, "--path", "orbit", "--fps", "8", "--seconds", "0.5", "--width", "40",
                  "--height", "50", "--out", tmp_path / "first") == 0
    path = tmp_path / "first" / "camera_path.json"
    for words, size, fps in (([], (40, 50), 8), (["--fps", "2", "--size", "100"], (80, 100), 2)):
        assert render(room, "--path", path, "--format", "mp4", *words,
                      "--out", tmp_path / str(fps)) == 0
        with av.open(str(tmp_path / str(fps) / "rgb.mp4")) as container:
            stream = container.streams.video[0]
            assert (stream.width, stream.height, stream.average_rate) == (*size, fps)


def test_a_video_is_made_again_only_where_it_is_another(room, tmp_path, capsys):
    words = ["--path", "orbit", *SHORT, "--format", "mp4", "--out", tmp_path / "out"]
    assert render(room, *words) == 0
    video = tmp_path / "out" / "rgb.mp4"
    first = video.stat().st_mtime_ns
    assert render(room, *words) == 0
    assert video.stat().st_mtime_ns == first
    capsys.readouterr()
    assert render(room, *words, "--crf", "40") == 0
    assert "0 of them rendered now" in capsys.readouterr().out
    assert video.stat().st_mtime_ns != first
    second = video.stat().st_mtime_ns
    (tmp_path / "out" / "rgb" / "00002.png").unlink()
    assert render(room, *words, "--crf", "40") == 0
    assert video.stat().st_mtime_ns != second


def test_one_video_or_picture_goes_where_a_file_is_named(copied, tmp_path, capsys):
    assert render(copied, *SHORT, "--out", tmp_path / "new" / "walk.mp4") == 0
    assert len(decoded(tmp_path / "new" / "walk.mp4")) == 4
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "new" / "walk.mp4")
    assert render(copied, "--views", "000001", "--out", tmp_path / "one.png") == 0
    assert (tmp_path / "one.png").read_bytes() == (
        copied / "render" / "views_000001-rgb" / "rgb" / "000001.png").read_bytes()
    assert render(copied, *SHORT, "--out", tmp_path / "two.png") == 2
    assert "4 frames" in capsys.readouterr().err


def test_up_that_is_not_known_is_said(before_a_wall, tmp_path, caplog):
    assert render(before_a_wall, "--path", "orbit", *SHORT, "--out", tmp_path / "out") == 0
    assert "up is not known" in caplog.text


def test_without_a_trained_model_the_command_to_type_is_named(copied, capsys):
    shutil.rmtree(copied / "train")
    assert render(copied) == 4
    said = capsys.readouterr().err
    assert "render needs train, which is missing" in said
    assert "Run `recon train" in said
    assert not (copied / "render").exists()


def test_an_empty_workspace_names_the_first_command(tmp_path, capsys):
    assert render(tmp_path / "none") == 4
    assert "Run `recon ingest VIDEO`" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_pruned_model_that_is_not_there_is_an_error_and_a_stale_one_is_left_out(
    copied, before_a_wall, tmp_path, capsys, caplog
):
    assert render(before_a_wall, "--model", "pruned", "--out", tmp_path / "out") == 4
    assert "Run `recon prune` first" in capsys.readouterr().err
    (copied / "prune" / "splats.ply").write_bytes((copied / "train" / "splats.ply").read_bytes())
    assert render(copied, "--views", "000001", "--out", tmp_path / "out") == 0
    assert "the pruned model is left out: it is stale" in caplog.text
    assert record(tmp_path / "out")["settings"]["model"] == "base"


@pytest.mark.parametrize(("words", "said"), [
    (["--views", "000099"], "no view '000099'"),
    (["--views", "000001.pgn"], "Did you mean 000001.png?"),
    (["--path", "orbit", "--views", "test"], "exclude each other"),
    (["--output", "rgb,normals"], "'rgb,normals' is no list"),
    (["--background", "white"], "no colour such as"),
    (["--size", "100000"], "MB to render"),
    (["--width", "321", "--format", "mp4"], "sides are even"),
    (["--format", "mp4", "--width", "40000", "--height", "2"], "libx264 does not make"),
])
def test_what_cannot_be_rendered_is_a_usage_error(copied, capsys, words, said):
    assert render(copied, *words) == 2
    assert said in capsys.readouterr().err
    assert not (copied / "render").exists()


def test_a_codec_that_is_missing_is_said_before_anything_is_rendered(
    copied, monkeypatch, capsys
):
    monkeypatch.setitem(videos.ENCODERS, "av1", ("libnone",))
    assert render(copied, "--format", "mp4", "--codec", "av1") == 2
    assert "cannot encode av1" in capsys.readouterr().err
    assert not (copied / "render").exists()


def test_a_file_that_is_no_path_is_an_input_error(room, tmp_path, capsys):
    (tmp_path / "path.json").write_text('{"camera_path": []}')
    assert render(room, "--path", tmp_path / "path.json", "--out", tmp_path / "out") == 3
    assert "lists no cameras" in capsys.readouterr().err


def test_a_folder_of_other_files_is_left_alone(room, tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.jpg").write_text("a photo")
    assert render(room, *SHORT, "--out", tmp_path / "photos") == 7
    assert "holds me.jpg" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["me.jpg"]


def test_a_folder_that_cannot_be_made_is_an_error(room, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert render(room, *SHORT, "--out", tmp_path / "file" / "out") == 7
    assert "cannot be made" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "said"), [
    (errno.ENOSPC, "disk is full"), (errno.EROFS, "not writable")])
def test_a_disk_that_takes_no_more_is_an_error_and_frames_stay(
    room, tmp_path, monkeypatch, capsys, number, said
):
    write, written = running.write_pictures, []

    def failing(*given):
        if written:
            raise OSError(number, os.strerror(number))
        written.append(1)
        write(*given)

    words = [*SHORT, "--out", tmp_path / "out"]
    with monkeypatch.context() as patch:
        patch.setattr(running, "write_pictures", failing)
        assert render(room, *words) == 7
    assert said in capsys.readouterr().err
    assert pictures(tmp_path / "out") == ["00000.png"]
    assert render(room, *words) == 0


def test_a_damaged_record_is_refused(room, tmp_path, capsys):
    words = [*SHORT, "--out", tmp_path / "out"]
    assert render(room, *words) == 0
    (tmp_path / "out" / "render.json").write_text("[]")
    assert render(room, *words) == 3
    assert "no record of recon render" in capsys.readouterr().err


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
            patch.setattr(frames, "write_json", die)
            with pytest.raises(Killed):
                render(room, *words, "--size", "40")
        assert render(room, *words) == 0
        assert pictures(tmp_path / "out") == [f"{number:05d}.png" for number in range(4)]
        assert read_image(tmp_path / "out" / "rgb" / "00000.png", 48, 36).any()
        assert record(tmp_path / "out")["settings"]["sizes"] == [[48, 36]]
