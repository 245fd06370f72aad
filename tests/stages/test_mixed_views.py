"""train, prune and evaluate on views of two cameras that differ in size and focal length."""

from __future__ import annotations

import json

import numpy as np
import pytest
from facts import assert_facts
from tiny_scene import TWO, make_inputs, write_masks

from recon_cli.config.stages import EvaluateConfig, PruneConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.evaluation.metrics import psnr
from recon_cli.io.images import read_image
from recon_cli.io.training_scene import load_scene
from recon_cli.io.views import size_summary
from recon_cli.stages import evaluate, prune, train
from recon_cli.train.fit import train_data
from recon_cli.train.fit.train_data import estimate_memory

CONFIG = RunConfig(
    iterations=160, densify_every=10, densify_gradient=1e-5, max_gaussians=120, sh_rate=0.05)
SIZES = {"000000.png": (48, 36), "000004.png": (30, 44), "000008.png": (48, 36)}  # held out


@pytest.fixture(scope="module", params=["torch", "numba"])
def done(request, tmp_path_factory):
    """The inputs with train and prune done, their summaries, and the context."""
    folder = tmp_path_factory.mktemp("mixed")
    inputs, ctx = make_inputs(folder, TWO), StageContext(backend=request.param)
    summaries = []
    for name, stage, config in (
        ("train", train, CONFIG), ("prune", prune, PruneConfig(ratio=0.3, at="mid"))
    ):
        (folder / name).mkdir()
        summaries.append(stage.run(config, inputs, folder / name, ctx))
        inputs = StageInputs({**inputs.folders, name: folder / name})
    return inputs, summaries, ctx


def evaluated(inputs, out, ctx, config=None):
    out.mkdir()
    evaluate.run(config or EvaluateConfig(), inputs, out, ctx)
    return json.loads((out / "metrics.json").read_text())


def mean_colour_psnr(image):
    """PSNR of painting a view in its own mean colour: what knowing nothing of its shape gives."""
    mean = np.broadcast_to(image.mean((0, 1)) / 255, image.shape).astype(np.float32)
    return psnr(mean, image)


@pytest.mark.integration
def test_views_of_both_cameras_are_learned_and_scored_at_their_own_size(done, tmp_path):
    inputs, _, ctx = done
    metrics = evaluated(inputs, tmp_path / "out", ctx)
    for model, least in (("base", 2), ("pruned", 1)):
        for view in metrics["models"][model]["views"]:
            width, height = SIZES[view["name"]]
            truth = read_image(
                inputs.folders["place"] / "undistorted" / "images" / view["name"], width, height)
            render = read_image(tmp_path / "out" / "renders" / model / view["name"], width, height)
            assert view["psnr_db"] > mean_colour_psnr(truth) + least
            assert view["psnr_db"] == pytest.approx(
                psnr((render / 255).astype(np.float32), truth), abs=0.15)


@pytest.mark.integration
def test_summaries_and_metrics_name_the_largest_size_and_all_of_them(done, tmp_path):
    inputs, (summary, _), ctx = done
    metrics = evaluated(inputs, tmp_path / "out", ctx)
    for held in (summary.to_json(), metrics):
        assert (held["width"], held["height"]) == (48, 36)
        assert held["sizes"] == [[48, 36], [30, 44]]
    assert_facts((tmp_path / "out" / "table.txt").read_text(), 3, "48x36", "30x44")


@pytest.mark.integration
def test_each_camera_is_reduced_to_the_longest_side_by_its_own_factor(done, tmp_path):
    inputs, _, ctx = done
    metrics = evaluated(inputs, tmp_path / "out", ctx, EvaluateConfig(max_size=32))
    assert metrics["sizes"] == [[32, 24], [22, 32]]


@pytest.mark.integration
def test_pruning_keeps_its_share_over_both_cameras(done):
    _, (_, summary), _ = done
    before = summary.gaussians_before
    assert summary.gaussians == before - int(0.3 * before)
    assert np.isfinite(summary.validation_psnr_db)


def test_the_largest_view_decides_the_memory_and_masks_are_counted(tmp_path, monkeypatch):
    asked = []

    def recorded(**values):
        asked.append(values)
        return estimate_memory(**values)

    monkeypatch.setattr(train_data, "estimate_memory", recorded)
    inputs = make_inputs(tmp_path, TWO[::-1])  # the smaller one comes first
    write_masks(inputs, {"000001.png": np.ones((44, 30), bool)})
    scene = load_scene(inputs.folders, validation=0.1)
    train_data.load_task(scene, CONFIG, StageContext())
    assert (asked[0]["width"], asked[0]["height"], asked[0]["masks"]) == (48, 36, 1)


def test_views_of_one_size_are_summarised_without_a_list():
    camera = TWO[0].at(np.eye(4))
    assert size_summary([camera, camera]) == {"width": 48, "height": 36}
