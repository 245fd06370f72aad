"""`recon render` in process, on workspaces of known truth."""

import json

import cv2
import numpy as np
import pytest
from facts import assert_facts
from render_cli import SHORT, pictures, record, render, times

from recon_cli.cli import main
from recon_cli.flythrough import run as running
from recon_cli.io.images import read_image


@pytest.mark.integration
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
    assert_facts(said["unit"], "thousandth", "extent")
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
    assert_facts(capsys.readouterr().out, 2, "rendered")
    after = times(tmp_path / "out")
    assert {name for name in after if after[name] != before[name]} == {"00001.png", "00003.png"}
    assert (tmp_path / "out" / "rgb" / "00001.png").read_bytes() == content
    assert pictures(tmp_path / "out", "alpha") == sorted(after)


@pytest.mark.parametrize("damage", [
    lambda data: data[:-20], lambda data: data + b"more", lambda _: b"text", lambda _: b"",
    lambda data: data[:60] + bytes([data[60] ^ 1]) + data[61:]])
def test_a_damaged_frame_is_rendered_again(room, tmp_path, damage):
    words, frame = ["--path", "orbit", *SHORT, "--out", tmp_path / "out"], tmp_path / "out" / "rgb"
    frame /= "00001.png"
    assert render(room, *words) == 0
    content = frame.read_bytes()
    frame.write_bytes(damage(content))
    assert render(room, *words) == 0
    assert frame.read_bytes() == content


def test_a_frame_that_was_replaced_by_another_picture_is_kept_and_named(room, tmp_path, caplog):
    words, folder = ["--path", "orbit", *SHORT, "--out", tmp_path / "out"], tmp_path / "out" / "rgb"
    assert render(room, *words) == 0
    other = (folder / "00002.png").read_bytes()
    (folder / "00001.png").write_bytes(other)
    assert render(room, *words) == 0
    assert_facts(caplog.text, "kept", "though", "rendered")
    assert "rgb/00001.png" in caplog.text
    assert (folder / "00001.png").read_bytes() == other


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
    [said_so] = [text for text in caplog.messages if "rendered again" in text]
    assert_facts(said_so, said, "settings", "changed")
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
    assert_facts(capsys.readouterr().err, "command", "again")
    assert pictures(tmp_path / "out") == ["00000.png", "00001.png"]
    assert not list(tmp_path.rglob("*.mp4"))
    assert render(room, *words) == 0
    assert_facts(capsys.readouterr().out, 2, "rendered")
    assert (tmp_path / "out" / "rgb.mp4").exists()
