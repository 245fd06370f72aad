"""`recon render --output trust`: what is written, and who has no trust."""

import cv2
import numpy as np
import pytest
from facts import assert_facts
from render_cli import pictures, record, render

from recon_cli.cli import main
from recon_cli.flythrough import model_trust
from recon_cli.trust.heat_map import INVENTED, TRUSTED, error_steps, heat_colors, tint
from recon_cli.workspace.records import ImportRecord


def test_trust_is_a_16_bit_picture_and_its_colours(room, tmp_path):
    out = tmp_path / "out"
    assert render(room, "--views", "test", "--output", "trust", "--out", out) == 0
    assert pictures(out, "trust") == pictures(out, "trust_color") == [
        "000000.png", "000004.png", "000008.png"]
    steps, colors = (cv2.imread(str(out / kind / "000000.png"), cv2.IMREAD_UNCHANGED)
                     for kind in ("trust", "trust_color"))
    assert (steps.dtype, steps.shape, colors.shape) == (np.uint16, (36, 48), (36, 48, 3))
    settings = record(out)["settings"]["trust"]
    expected = (steps * settings["error_per_step"]).astype(np.float32)
    assert 0 < expected.mean() < 1
    near = np.abs(heat_colors(expected).astype(int) - colors[:, :, ::-1]).max()
    assert near <= 8  # 16 bits may round to the next of 256 colours


def test_eval_keeps_what_render_shows(copied, tmp_path, monkeypatch):
    words = ["--views", "000000", "--output", "trust", "--out"]
    assert render(copied, *words, tmp_path / "now") == 0
    assert main(["eval", "-w", str(copied), "--threads", "1"]) == 0
    monkeypatch.setattr(model_trust, "measure_trust", None)  # would fail
    assert render(copied, *words, tmp_path / "kept") == 0
    one, two = (cv2.imread(str(tmp_path / name / "trust" / "000000.png"), cv2.IMREAD_UNCHANGED)
                for name in ("now", "kept"))
    assert np.abs(one.astype(int) - two).max() <= 1


def test_a_single_picture_is_the_coloured_one(room, tmp_path):
    out = tmp_path / "heat.png"
    assert render(room, "--views", "000000", "--output", "trust", "--out", out) == 0
    assert cv2.imread(str(out), cv2.IMREAD_UNCHANGED).shape == (36, 48, 3)


def test_an_import_without_views_has_no_trust_and_says_why(copied, capsys):
    ImportRecord("room.ply", "ply", "0", 60, 0, z_up=True, views=False).write(copied / "train")
    path = ["--path", "orbit", "--fps", "4", "--seconds", "1", "--output", "trust"]
    assert render(copied, *path) != 0
    assert_facts(capsys.readouterr().err, "imported", "views")


def test_colours_go_from_blue_to_red_by_the_logarithm():
    errors = np.array([0, TRUSTED, np.sqrt(TRUSTED * INVENTED), INVENTED, 1], np.float32)
    blue, same, green, red, most = heat_colors(errors).astype(int)
    assert (blue == same).all()
    assert blue[2] > max(blue[:2])
    assert green[1] > max(green[0], green[2])
    assert (red == most).all()
    assert red[0] > 2 * max(red[1:])
    mixed = tint(np.full((5, 3), 255, np.uint8), errors).astype(int)
    assert (mixed[0] >= blue).all()
    assert error_steps(np.array([0, 0.5, 1, 2], np.float32)).tolist() == [0, 32768, 65535, 65535]


@pytest.mark.parametrize("words", [["--output", "rgb,truth"], ["--output", ""]])
def test_unknown_outputs_are_refused(room, words):
    assert render(room, "--views", "test", *words) == 2
