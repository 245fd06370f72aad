"""export into other formats: what is written, what each loses, and what is refused."""

from __future__ import annotations

import json
import logging
import shutil

import numpy as np
import pytest
from facts import raises
from tiny_stages import CONTEXT, run_export

from recon_cli.config.export import ExportConfig
from recon_cli.context import StageInputs
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.io.colmap import read_images
from recon_cli.splats.format import SplatFormat
from recon_cli.splats.ply import read_ply, read_ply_points, write_ply
from recon_cli.splats.registry import FORMATS, read_splats
from recon_cli.workspace.export_formats import EXPORT_FORMATS, PLAN

ASKED = [name for name in EXPORT_FORMATS if name != PLAN]  # the tiny scene has no scale


@pytest.fixture
def inputs(tiny_learnt):
    """A short training of the tiny scene."""
    return tiny_learnt


@pytest.fixture(scope="module")
def exported(tiny_learnt, tmp_path_factory):
    """All formats at once: the folder and the summary."""
    out = tmp_path_factory.mktemp("export")
    return out, run_export(ExportConfig(format=",".join(ASKED)), tiny_learnt, out, CONTEXT)


@pytest.mark.integration
def test_every_format_lies_beside_the_ply_and_shows_the_same_scene(exported, inputs):
    out, summary = exported
    assert set(summary.files) == set(ASKED) - {"ply"}
    ply = out / "splats.ply"
    for name in FORMATS.keys() - {"ply"}:
        told = summary.files[name]
        path = out / told.file
        trained = read_ply(inputs.folders["train"] / "splats.ply").with_sphere()
        assert len(read_splats(path)) == len(trained if name == "html" else read_ply(ply))
        files = path.parent.rglob("*.*") if name == "lod" else [path]
        size = sum(file.stat().st_size for file in files)
        assert told.bytes == size
        assert told.smaller == pytest.approx(ply.stat().st_size / size, abs=1e-3)
        assert -EXPORT_FORMATS[name].max_loss_db <= told.psnr_change_db < 0.3, name
    assert abs(summary.files["glb"].psnr_change_db) < 1e-3  # it keeps every value


@pytest.mark.integration
def test_cameras_are_those_of_the_scene(exported, inputs):
    out, _ = exported
    found = {name: viewmat for name, _, viewmat in read_images(out / "sparse" / "0" / "images.bin")}
    sparse = inputs.folders["place"] / "undistorted" / "sparse"
    for name, _, viewmat in read_images(sparse / "images.bin"):
        assert np.allclose(found[name], viewmat, atol=1e-12)
    transforms = json.loads((out / "transforms.json").read_text())
    assert len(transforms["frames"]) == len(found)
    held_out = {frame["name"] for frame in json.loads(
        (inputs.folders["ingest"] / "frames.json").read_text())["frames"] if frame["held_out"]}
    assert {name.removeprefix("images/") for name in transforms["test_filenames"]} == held_out


@pytest.mark.integration
def test_the_images_of_the_cameras_lie_beside_them(exported, inputs):
    out, _ = exported
    transforms = json.loads((out / "transforms.json").read_text())
    for frame in transforms["frames"]:
        image = out / frame["file_path"]
        original = inputs.folders["place"] / "undistorted" / "images" / image.name
        assert image.read_bytes() == original.read_bytes()


@pytest.mark.slow
def test_an_export_that_was_killed_goes_on_over_what_it_left(exported, inputs, tmp_path):
    whole, _ = exported
    out = tmp_path / "export"
    shutil.copytree(whole, out)
    (out / "transforms.json").unlink()
    (out / "sparse" / "0" / "images.bin").unlink()
    run_export(ExportConfig(format=",".join(ASKED)), inputs, out, CONTEXT)
    before, after = ({path.relative_to(folder): path.read_bytes()
                      for path in folder.rglob("*") if path.is_file()} for folder in (whole, out))
    assert before == after


def test_points_are_those_of_the_room_not_of_what_its_windows_show(inputs, tmp_path):
    folder = tmp_path / "train"
    shutil.copytree(inputs.folders["train"], folder)
    splats = read_ply(folder / "splats.ply")
    splats.logit_opacities[:] = 3.0
    splats.means[-5:] *= 1e4
    write_ply(folder / "splats.ply", splats)
    (tmp_path / "out").mkdir()
    run_export(ExportConfig(format="points.ply"),
               StageInputs({**inputs.folders, "train": folder}), tmp_path / "out", CONTEXT)
    points, _ = read_ply_points(tmp_path / "out" / "points.ply")
    assert len(points) == len(splats) - 5


def test_what_each_format_loses_is_said(inputs, tmp_path, caplog):
    caplog.set_level(logging.INFO, "recon")
    run_export(ExportConfig(format="spz"), inputs, tmp_path, CONTEXT)
    assert any("spz: " in line and "x smaller, " in line and " dB" in line
               for line in caplog.messages)


def test_a_format_that_loses_more_than_it_may_is_refused(inputs, tmp_path, monkeypatch):
    real = FORMATS["spz"]

    def darker(path):
        scene = real.load(path)
        scene.splats.sh_dc -= 1.0
        return scene

    monkeypatch.setitem(FORMATS, "spz", SplatFormat(darker, real.write_with))
    with raises(ReconstructionError, "0.3", "dB") as error:
        run_export(ExportConfig(format="spz"), inputs, tmp_path)
    assert "--max-loss" in error.value.hint
    assert run_export(ExportConfig(format="spz", max_loss=100.0), inputs, tmp_path).files


def test_a_scene_that_is_measured_is_scored_in_its_new_world(inputs, tmp_path):
    config = ExportConfig(
        format="glb", scale_between=("000000.png", "000006.png", 7.0), backdrop="keep")
    summary = run_export(config, inputs, tmp_path, CONTEXT)
    assert abs(summary.files["glb"].psnr_change_db) < 1e-3
    before = read_ply(inputs.folders["train"] / "splats.ply")
    after = FORMATS["glb"].read(tmp_path / "splats.glb")
    before = before.with_sphere().means.norm(dim=1).median()
    assert after.means.norm(dim=1).median() == pytest.approx(
        float(summary.transform["scale"] * before), rel=1e-4)


@pytest.mark.parametrize("text", ["", "ksplat", "spz,usdz"])
def test_an_unknown_format_is_refused_with_those_that_are_known(text):
    with raises(ConfigError, "compressed.ply"):
        ExportConfig(format=text)



