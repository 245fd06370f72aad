"""train, prune and evaluate where masks ignore pixels, on both backends."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from facts import assert_facts, raises
from tiny_scene import make_inputs, write_masks

from recon_cli.config.stages import EvaluateConfig, PruneConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ReconstructionError, TrainingError
from recon_cli.io.images import read_image, write_png
from recon_cli.stages import evaluate, prune, train
from recon_cli.train.fit import runner
from recon_cli.train.fit.state import save_state

pytestmark = pytest.mark.integration

CONFIG = TrainConfig(
    iterations=60, densify_every=10, densify_gradient=1e-5, max_gaussians=120, sh_rate=0.05,
    checkpoint_every=7)
PRUNE = PruneConfig(ratio=0.5, at="mid")
BACKENDS = ["torch", "numba"]
every_backend = pytest.mark.parametrize("backend", BACKENDS)
TRAINED, VALIDATED, SCORED, UNMASKED = "000002.png", "000006.png", "000004.png", "000008.png"
ALL_BUT_A_CORNER = np.ones((36, 48), bool)
ALL_BUT_A_CORNER[:20, :17] = False
NOTHING = np.zeros((36, 48), bool)


def context(backend):
    return StageContext(backend=backend)


def run(stage, config, inputs, out, backend="torch"):
    out.mkdir(exist_ok=True)
    return stage.run(config, inputs, out, context(backend))


def spoil(inputs, seed):
    """Puts other pixels under the masks of the images that sfm left."""
    rng = np.random.default_rng(seed)
    for folder in ("images", "denoised"):
        for name in (TRAINED, VALIDATED, SCORED):
            path = inputs.folders["place"] / "undistorted" / folder / name
            image = read_image(path, 48, 36)
            image[~ALL_BUT_A_CORNER] = rng.integers(0, 256, 3)
            write_png(path, image)


def finished(folder, backend, seed):
    """Inputs of which three views are masked, with train and prune done."""
    folder.mkdir()
    given = make_inputs(folder)
    write_masks(given, dict.fromkeys((TRAINED, VALIDATED, SCORED), ALL_BUT_A_CORNER))
    spoil(given, seed)
    run(train, CONFIG, given, folder / "train", backend)
    both = StageInputs({**given.folders, "train": folder / "train"})
    run(prune, PRUNE, both, folder / "prune", backend)
    return StageInputs({**both.folders, "prune": folder / "prune"})


@pytest.fixture(scope="module", params=BACKENDS)
def given(request, tmp_path_factory):
    """The backend, and the same capture twice with other pixels under the masks."""
    folder = tmp_path_factory.mktemp("masked")
    return request.param, [finished(folder / str(i), request.param, i) for i in range(2)]


def test_nothing_under_a_mask_changes_a_byte_of_the_models(given):
    _, (first, second) = given
    for stage in ("train", "prune"):
        assert (first.folders[stage] / "splats.ply").read_bytes() == (
            second.folders[stage] / "splats.ply").read_bytes(), stage
    reports = [json.loads((inputs.folders["train"] / "log.jsonl").read_text().splitlines()[-1])
               for inputs in (first, second)]
    assert reports[0]["validation_psnr_db"] == reports[1]["validation_psnr_db"]


def test_nothing_under_a_mask_changes_a_score(given, tmp_path):
    backend, captures = given
    models = []
    for i, inputs in enumerate(captures):
        run(evaluate, EvaluateConfig(), inputs, tmp_path / str(i), backend)
        metrics = json.loads((tmp_path / str(i) / "metrics.json").read_text())
        models.append({name: model["views"] for name, model in metrics["models"].items()})
    assert models[0] == models[1]


def test_masked_views_say_how_much_was_scored_and_are_black_in_the_difference(given, tmp_path):
    backend, (inputs, _) = given
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "out", backend)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    views = {view["name"]: view for view in metrics["models"]["base"]["views"]}
    assert views[SCORED]["pixels_scored"] == pytest.approx(1 - 20 * 17 / (36 * 48))
    assert set(views[UNMASKED]) == {
        "name", "psnr_db", "psnr_8bit_db", "ssim", "ssim_padded", "gain_psnr_db"}
    assert_facts((tmp_path / "out" / "table.txt").read_text(), 1, 3, "Masks", "views")
    assert "ignored pixels" in metrics["mask_convention"]
    difference = read_image(tmp_path / "out" / "difference" / "base" / SCORED, 48, 36)
    assert not difference[~ALL_BUT_A_CORNER].any()
    assert difference[ALL_BUT_A_CORNER].any()


def test_a_killed_training_with_masks_ends_with_the_bytes_of_an_uninterrupted_one(
    given, tmp_path, monkeypatch
):
    backend, (inputs, _) = given

    class Killed(Exception):  # noqa: N818 - an event, not an error
        pass

    def save_then_die(path, state):
        save_state(path, state)
        if state.iteration >= 28:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(runner, "save_state", save_then_die)
        with pytest.raises(Killed):
            run(train, CONFIG, inputs, tmp_path / "out", backend)
    run(train, CONFIG, inputs, tmp_path / "out", backend)
    for name in ("splats.ply", "mid.safetensors", "final.safetensors"):
        assert (tmp_path / "out" / name).read_bytes() == (
            inputs.folders["train"] / name).read_bytes(), name


def copied(inputs, tmp_path, masks):
    """The same inputs with further masks."""
    folder = tmp_path / "place"
    shutil.copytree(inputs.folders["place"], folder)
    changed = StageInputs({**inputs.folders, "place": folder})
    write_masks(changed, masks)
    return changed


def test_a_training_view_whose_mask_leaves_nothing_is_left_out_with_a_notice(
    given, tmp_path, caplog
):
    backend, (inputs, _) = given
    changed = copied(inputs, tmp_path, {"000003.png": NOTHING})
    before = json.loads((inputs.folders["ingest"] / "frames.json").read_text())["frames"]
    summary = run(train, replace(CONFIG, iterations=2), changed, tmp_path / "out", backend)
    kept = sum(not frame["held_out"] for frame in before) - 1
    assert summary.training_views + summary.validation_views == kept
    assert_facts(caplog.text, 1, "views", "trained")
    assert "000003.png" in caplog.text


def test_masks_that_leave_nothing_to_train_on_are_an_error(given, tmp_path):
    _, (inputs, _) = given
    changed = copied(inputs, tmp_path, {f"{i:06d}.png": NOTHING for i in range(12)})
    with raises(TrainingError, 0, "masks") as caught:
        run(train, CONFIG, changed, tmp_path / "out")
    assert "recon ingest" in caught.value.hint


def test_a_held_out_view_whose_mask_leaves_nothing_is_not_scored_and_named(
    given, tmp_path, caplog
):
    backend, (inputs, _) = given
    changed = copied(inputs, tmp_path, {UNMASKED: NOTHING})
    summary = run(evaluate, EvaluateConfig(), changed, tmp_path / "out", backend)
    assert summary.test_views == 2
    assert summary.masked_out_test == (UNMASKED,)
    assert_facts(caplog.text, 1, "views", "scored")


def test_masks_that_leave_nothing_to_score_are_an_error(given, tmp_path):
    _, (inputs, _) = given
    changed = copied(inputs, tmp_path, dict.fromkeys(("000000.png", SCORED, UNMASKED), NOTHING))
    with raises(ReconstructionError, 3, "score"):
        run(evaluate, EvaluateConfig(), changed, tmp_path / "out")
