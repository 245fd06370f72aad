"""A user's masks of what moves: trained by, kept, pruned by, and named by evaluate."""

import json
from dataclasses import replace

import numpy as np
import pytest
from facts import assert_facts, raises
from tiny_scene import make_inputs
from tiny_stages import PRUNE

from recon_cli.config.stages import EvaluateConfig, RunConfig
from recon_cli.context import EarlierResult, StageContext, StageInputs
from recon_cli.errors import InputError
from recon_cli.evaluation.scores import Metrics
from recon_cli.io.images import write_png
from recon_cli.stages import evaluate, prune, train
from recon_cli.train.parts import moving

pytestmark = pytest.mark.integration
MASKED = "000002.png"
CONFIG = RunConfig(iterations=30, densify_every=10, max_gaussians=120, background="off",
                   stereo="off", exposure="off", validation=0.0)


def run(stage, config, inputs, out):
    out.mkdir(exist_ok=True)
    return stage.run(config, inputs, out, StageContext(backend="numba"))


@pytest.fixture
def inputs(tmp_path):
    """Inputs of a training after one to which a user added a mask of the left half of a view."""
    earlier = tmp_path / "earlier"
    (earlier / "masks").mkdir(parents=True)
    mask = np.full((36, 48), 255, np.uint8)
    mask[:, :24] = 0
    write_png(earlier / "masks" / MASKED, mask)
    given = make_inputs(tmp_path)
    return StageInputs(given.folders, earlier=EarlierResult(
        earlier, {}, foreign=frozenset({f"masks/{MASKED}"})))


def test_pixels_under_a_users_mask_change_nothing_in_training_or_pruning(inputs, tmp_path):
    results = []
    for name in ("first", "second"):
        folders = {**inputs.folders, "train": tmp_path / name / "train"}
        (tmp_path / name).mkdir()
        summary = run(train, CONFIG, inputs, folders["train"])
        assert summary.moving.by_hand == (MASKED,)
        assert summary.moving.shares == {MASKED: 0.5}
        run(prune, PRUNE, StageInputs(folders), tmp_path / name / "prune")
        results.append([(tmp_path / name / stage / "splats.ply").read_bytes()
                        for stage in ("train", "prune")])
        for kind in ("images", "denoised"):
            path = inputs.folders["place"] / "undistorted" / kind / MASKED
            pixels = np.zeros((36, 48, 3), np.uint8)
            pixels[:, 24:] = _read(path)[:, 24:]
            write_png(path, pixels)
    assert results[0] == results[1]


def _read(path):
    from recon_cli.io.images import read_image

    return read_image(path, 48, 36)


def test_an_unreadable_mask_is_refused_before_training(inputs, tmp_path):
    (inputs.earlier.folder / "masks" / MASKED).write_bytes(b"no picture")
    with raises(InputError, "mask"):
        run(train, CONFIG, inputs, tmp_path / "train")


def test_evaluate_names_held_out_views_in_which_something_moves(inputs, tmp_path, monkeypatch):
    run(train, CONFIG, inputs, tmp_path / "train")
    regions = [np.zeros((36, 48), bool) for _ in range(3)]
    regions[1][:, 30:] = True
    monkeypatch.setattr(evaluate, "find_in_held_out", lambda *_: regions)
    folders = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    run(evaluate, EvaluateConfig(trust=False), folders, tmp_path / "evaluate")
    metrics = Metrics.read(tmp_path / "evaluate")
    name, = metrics.moving
    assert metrics.moving[name] == 0.375
    model = metrics.models["base"]
    assert model.static_psnr_db != model.psnr_db
    assert_facts((tmp_path / "evaluate/table.txt").read_text(), name, "37.5%")


def test_evaluate_compares_nothing_where_nothing_was_masked(inputs, tmp_path):
    run(train, CONFIG, replace(inputs, earlier=None), tmp_path / "train")
    folders = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    run(evaluate, EvaluateConfig(trust=False), folders, tmp_path / "evaluate")
    value = json.loads((tmp_path / "evaluate/metrics.json").read_text())
    assert "moving" not in value
    assert "static_psnr_db" not in value["models"]["base"]


def test_held_out_views_are_compared_with_some_of_the_training(monkeypatch):
    seen = []
    monkeypatch.setattr(moving, "compare_view", lambda _splats, view, *_, **__: view)
    monkeypatch.setattr(moving, "find_moving",
                        lambda own, others: seen.append((len(own), len(others))) or [])
    moving.find_in_held_out(None, [], range(300), moving.ViewComparer(0, "numba"))
    assert seen == [(0, 60)]
