"""A scene that is measured after training is exported in metres, without a new training."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from facts import assert_facts
from scenes import random_splats
from tiny_scene import make_inputs
from tiny_stages import run_export

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.export.coordinate_frame import choose_frame, find_room_frame
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.render import render
from recon_cli.room.scale_fusion import ScaleSource
from recon_cli.scene.camera import Camera
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.poses.align_world import world_transform
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.train.fit.train_data import write_config


@pytest.fixture
def inputs(tmp_path):
    """ingest and sfm of the tiny scene, and Gaussians that stand for a training."""
    given = make_inputs(tmp_path)
    (tmp_path / "train").mkdir()
    write_ply(tmp_path / "train" / "splats.ply", random_splats(30, dtype=torch.float32))
    write_config(tmp_path / "train", RunConfig())
    (tmp_path / "out").mkdir()
    return StageInputs({**given.folders, "train": tmp_path / "train"})


def test_a_measured_scene_is_larger_and_looks_the_same(inputs, tmp_path):
    # Frames 0 and 6 of the tiny scene: (0.4, 0, 0) and 0.4 (cos 6, sin 6), 0.6, seen from outside.
    apart = np.linalg.norm([0.4 - 0.4 * np.cos(6), -0.4 * np.sin(6), -0.6])
    config = ExportConfig(scale_between=("000000.png", "000006.png", float(3 * apart)))
    summary = run_export(config, inputs, tmp_path / "out", StageContext())
    before = read_ply(tmp_path / "train" / "splats.ply")
    after = read_ply(tmp_path / "out" / "splats.ply")
    assert torch.allclose(after.means, 3 * before.means, rtol=1e-6)
    assert torch.equal(after.sh_rest, before.sh_rest)
    similarity = Similarity.from_json(summary.transform)
    assert similarity.scale == pytest.approx(3, rel=1e-9)
    viewmat = np.eye(4)
    viewmat[2, 3] = 2
    camera = Camera(40, 30, 35.0, 35.0, 20.0, 15.0, viewmat)
    with torch.no_grad():
        old = render(before, camera, torch.zeros(3), 3, backend="torch").rgb
        new = render(after, similarity.camera(camera), torch.zeros(3), 3, backend="torch").rgb
    assert torch.allclose(old, new, atol=1e-4)



def test_an_export_that_measures_nothing_says_that_nothing_was_moved(inputs, tmp_path):
    summary = run_export(ExportConfig(), inputs, tmp_path / "out", StageContext())
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    assert Similarity.from_json(record["similarity"]).is_identity
    assert summary.transform == record["similarity"]
    assert record["measurement"] is None
    assert (tmp_path / "out" / "splats.ply").read_bytes() == (
        tmp_path / "train" / "splats.ply").read_bytes()
    assert summary.files == {}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"splats.ply", "transform.json"}


APART = float(np.linalg.norm([0.4 - 0.4 * np.cos(6), -0.4 * np.sin(6), -0.6]))  # frames 0 and 6


def know_scale(inputs, **more):
    """Writes the world that sfm would record, with z up."""
    viewmats = {f"{at:06d}.png": np.eye(4) for at in range(3)}
    world = world_transform(np.zeros((0, 3)), viewmats, given_up=(0.0, 0.0, 1.0),
                            level_views=np.array(list(viewmats.values())),
                            **{"scale_between": None, "metric": True, **more})
    (inputs.folders["place"] / "world.json").write_text(json.dumps(world.summary().to_json()))


def spread_scale(inputs, spread):
    """Says how far the scales of two parts of the capture may differ."""
    path = inputs.folders["place"] / "world.json"
    world = json.loads(path.read_text())
    world["evidence"]["scale_spread"] = spread
    path.write_text(json.dumps(world))


def read(inputs):
    return PlacedCapture.read(inputs.folders)


def measured(metres):
    return ExportConfig(scale_between=("000000.png", "000006.png", metres))


def test_what_sfm_knew_and_what_is_measured_later_give_one_scale(inputs, tmp_path):
    # One unit of the mapper had 2 m, by the device to 1%: the world is in metres.
    know_scale(inputs, sources=[ScaleSource("the tracked poses", 2.0, 0.01)])
    frame = choose_frame(measured(1.01 * APART), read(inputs), None)
    error = np.hypot(0.003, np.sqrt(2) * 0.003 / (1.01 * APART))  # of the measuring
    weights = np.array([error, 0.01])**-2.0
    assert np.log(frame.fused.scale) == pytest.approx(np.log(1.01) * weights[0] / weights.sum())
    assert find_room_frame(read(inputs), frame).scale_error == pytest.approx(weights.sum()**-0.5)
    run_export(measured(1.01 * APART), inputs, tmp_path / "out", StageContext())
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    assert record["scale"]["error"] == pytest.approx(weights.sum()**-0.5)
    assert [one["name"] for one in record["scale"]["used"]] == [
        "--scale-between", "the tracked poses"]


def test_a_length_that_contradicts_what_sfm_knew_decides_and_both_are_named(
    inputs, tmp_path
):
    know_scale(inputs, sources=[ScaleSource("sensor depth", 1.0, 0.005)])
    told = []

    class Context(StageContext):
        def notice(self, text):
            told.append(text)

    run_export(measured(1.5 * APART), inputs, tmp_path / "out", Context())
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    assert record["similarity"]["scale"] == pytest.approx(1.5)
    assert_facts("\n".join(told), "33.3%", "--scale-between")


def test_a_length_of_sfm_and_one_of_export_are_both_used(inputs):
    know_scale(inputs, metric=False, sources=[ScaleSource("--scale-between", 3.0, 0.01)])
    frame = choose_frame(measured(APART), read(inputs), None)
    assert [one.name for one in frame.fused.used] == [
        "--scale-between", "--scale-between of recon sfm"]
    assert frame.fused.scale == pytest.approx(1)


@pytest.mark.parametrize("error", [0.003, 0.02])
def test_measures_carry_the_interval_of_the_scale_that_sfm_found(inputs, error):
    sources = [] if error == 0.003 else [ScaleSource("sensor depth", 1.0, error)]
    know_scale(inputs, sources=sources)  # without any, the data set's own unit
    frame = choose_frame(ExportConfig(), read(inputs), None)
    assert find_room_frame(read(inputs), frame).scale_error == pytest.approx(error)


@pytest.mark.parametrize("config", [ExportConfig(), measured(APART)])
def test_measures_carry_how_far_the_scale_drifts_within_the_capture(inputs, config):
    know_scale(inputs)
    own = find_room_frame(read(inputs), choose_frame(config, read(inputs), None)).scale_error
    spread_scale(inputs, 0.08)
    carried = find_room_frame(read(inputs), choose_frame(config, read(inputs), None)).scale_error
    assert carried == pytest.approx(np.hypot(own, 0.08))
