"""A scene that is measured after training is exported in metres, without a new training."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scenes import random_splats
from tiny_scene import make_inputs

from recon_cli.config.export import ExportConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.similarity import Similarity
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.stages import export


@pytest.fixture
def inputs(tmp_path):
    """ingest and sfm of the tiny scene, and Gaussians that stand for a training."""
    given = make_inputs(tmp_path)
    (tmp_path / "train").mkdir()
    write_ply(tmp_path / "train" / "splats.ply", random_splats(30, dtype=torch.float32))
    (tmp_path / "out").mkdir()
    return StageInputs({**given.folders, "train": tmp_path / "train"})


def test_a_measured_scene_is_larger_and_looks_the_same(inputs, tmp_path):
    # Frames 0 and 6 of the tiny scene: (0.4, 0, 0) and 0.4 (cos 6, sin 6), 0.6, seen from outside.
    apart = np.linalg.norm([0.4 - 0.4 * np.cos(6), -0.4 * np.sin(6), -0.6])
    config = ExportConfig(scale_between=("000000.png", "000006.png", float(3 * apart)))
    summary = export.run(config, inputs, tmp_path / "out", StageContext())
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


def test_the_transform_is_recorded_with_what_was_measured(inputs, tmp_path):
    config = ExportConfig(scale_between=("000000.png", "5,5,5", 2.0))
    export.run(config, inputs, tmp_path / "out", StageContext())
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    ends = np.array([record["measurement"]["a_xyz"], record["measurement"]["b_xyz"]])
    assert record["similarity"]["scale"] * np.linalg.norm(ends[0] - ends[1]) == pytest.approx(2.0)
    assert record["measurement"]["a"] == "000000.png"


def test_an_export_that_measures_nothing_says_that_nothing_was_moved(inputs, tmp_path):
    summary = export.run(ExportConfig(), inputs, tmp_path / "out", StageContext())
    record = json.loads((tmp_path / "out" / "transform.json").read_text())
    assert Similarity.from_json(record["similarity"]).is_identity
    assert summary.transform == record["similarity"]
    assert record["measurement"] is None
    assert (tmp_path / "out" / "splats.ply").read_bytes() == (
        tmp_path / "train" / "splats.ply").read_bytes()


def test_a_frame_without_a_camera_stops_the_export_before_it_writes(inputs, tmp_path):
    config = ExportConfig(scale_between=("000099.png", "000006.png", 1.0))
    with pytest.raises(ConfigError, match=r"000009\.png"):
        export.run(config, inputs, tmp_path / "out", StageContext())
    assert list((tmp_path / "out").iterdir()) == []
