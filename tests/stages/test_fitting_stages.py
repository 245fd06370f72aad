"""train, prune, evaluate and export on a tiny scene: what they leave, and going on after a stop."""

from __future__ import annotations

import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_scene import VIEWS, make_inputs

from recon_cli.config import EvaluateConfig, ExportConfig, PruneConfig, RunConfig
from recon_cli.errors import (
    ConfigError,
    FormatError,
    ReconstructionError,
    StageError,
    TrainingError,
)
from recon_cli.io.images import read_image
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.metrics import psnr, ssim
from recon_cli.stages import course, evaluate, export, fitting, held_out, prune, train
from recon_cli.stages.context import StageContext, StageInputs
from recon_cli.train.state import save_state

CONFIG = RunConfig(
    iterations=160, densify_every=10, densify_gradient=1e-5, max_gaussians=120, sh_rate=0.05,
    checkpoint_every=7)
RUN = RunConfig(**{**vars(CONFIG), "max_size": 400, "sh_degree": 3})
PRUNE = PruneConfig(ratio=0.5, at="mid")
CONTEXT = StageContext()


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """ingest, sfm, and a finished train and prune."""
    folder = tmp_path_factory.mktemp("tiny")
    given = make_inputs(folder)
    for name in ("train", "prune"):
        (folder / name).mkdir()
    train.run(CONFIG, given, folder / "train", CONTEXT)
    both = StageInputs({**given.folders, "train": folder / "train"})
    prune.run(PRUNE, both, folder / "prune", CONTEXT)
    return StageInputs({**both.folders, "prune": folder / "prune"})


def run(stage, config, inputs, out, ctx=CONTEXT):
    out.mkdir(exist_ok=True)
    return stage.run(config, inputs, out, ctx)


def without(inputs, *names):
    return StageInputs({k: v for k, v in inputs.folders.items() if k not in names})


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill: nothing gets the chance to clean up."""


def stopping_after(steps, monkeypatch):
    """Makes the training loop die right after a step, as kill -9 would."""
    def save_then_die(path, state):
        save_state(path, state)
        if state.iteration >= steps:
            raise Killed

    monkeypatch.setattr(fitting, "save_state", save_then_die)


def test_training_leaves_a_scene_its_states_and_a_log(inputs):
    folder = inputs.folders["train"]
    assert sorted(p.name for p in folder.iterdir()) == [
        "config.json", "final.safetensors", "log.jsonl", "mid.safetensors",
        "plan.json", "splats.ply"]
    rows = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert rows[-1]["iteration"] == 160
    assert rows[-1]["gaussians"] == len(read_ply(folder / "splats.ply"))
    assert rows[-1]["validation_psnr_db"] > mean_colour_psnr(inputs) + 2


def mean_colour_psnr(inputs):
    """PSNR of painting a view in its own mean colour: what knowing nothing of its shape gives."""
    image = read_image(inputs.folders["sfm"] / "undistorted" / "images" / "000006.png", 48, 36)
    mean = np.broadcast_to(image.mean((0, 1)) / 255, image.shape).astype(np.float32)
    return psnr(mean, image)


def test_two_runs_give_the_same_bytes(inputs, tmp_path):
    run(train, CONFIG, inputs, tmp_path / "again")
    for name in ("splats.ply", "mid.safetensors", "final.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (
            inputs.folders["train"] / name).read_bytes(), name


@pytest.mark.parametrize("steps", [7, 91, 98])
def test_a_killed_training_ends_with_the_bytes_of_an_uninterrupted_one(
    inputs, tmp_path, monkeypatch, steps
):
    with monkeypatch.context() as patch:
        stopping_after(steps, patch)
        with pytest.raises(Killed):
            run(train, CONFIG, inputs, tmp_path / "out")
    run(train, CONFIG, inputs, tmp_path / "out")
    for name in ("splats.ply", "mid.safetensors", "final.safetensors"):
        assert (tmp_path / "out" / name).read_bytes() == (
            inputs.folders["train"] / name).read_bytes(), name


def test_ctrl_c_saves_the_state_and_training_goes_on_from_there(inputs, tmp_path, monkeypatch):
    recorded = []

    def press(done, total):
        recorded.append((done, total))

    original = fitting.fit

    def fit_and_press(state, task, until, *, on_step, **others):
        def step(now):
            if now.iteration == 10:
                os.kill(os.getpid(), signal.SIGINT)
            on_step(now)
        original(state, task, until, on_step=step, **others)

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "fit", fit_and_press)
        with pytest.raises(KeyboardInterrupt):
            run(train, CONFIG, inputs, tmp_path / "out", replace(CONTEXT, record=press))
    assert recorded[-1] == (10, 160)
    run(train, CONFIG, inputs, tmp_path / "out")
    assert (tmp_path / "out" / "splats.ply").read_bytes() == (
        inputs.folders["train"] / "splats.ply").read_bytes()


def test_pruning_at_mid_halves_the_count_and_both_models_saw_as_many_steps(inputs, tmp_path):
    summary = run(prune, PRUNE, inputs, tmp_path / "prune")
    assert summary["gaussians"] == summary["gaussians_before"] - summary["gaussians_before"] // 2
    assert summary["iterations"] == CONFIG.iterations
    assert summary["recovery_steps"] == 64
    assert len(read_ply(tmp_path / "prune" / "splats.ply")) == summary["gaussians"]
    assert (tmp_path / "prune" / "splats.ply").read_bytes() == (
        inputs.folders["prune"] / "splats.ply").read_bytes()
    assert (inputs.folders["train"] / "splats.ply").exists()


def test_a_killed_recovery_ends_with_the_same_bytes(inputs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stopping_after(119, patch)
        patch.setattr(course, "read_config", lambda _: RUN)  # checkpoints every 7 steps
        with pytest.raises(Killed):
            run(prune, PRUNE, inputs, tmp_path / "out")
    run(prune, PRUNE, inputs, tmp_path / "out")
    assert (tmp_path / "out" / "splats.ply").read_bytes() == (
        inputs.folders["prune"] / "splats.ply").read_bytes()


def test_pruning_the_finished_run_without_recovery_only_removes(inputs, tmp_path):
    config = PruneConfig(ratio=0.3, at="end", recovery=0)
    summary = run(prune, config, inputs, tmp_path / "out")
    kept, before = (read_ply(folder / "splats.ply")
                    for folder in (tmp_path / "out", inputs.folders["train"]))
    rows = torch.cdist(kept.means, before.means).argmin(1)
    assert torch.equal(before.means[rows], kept.means)
    assert summary["recovery_steps"] == 0
    assert summary["train_seconds"] > 0


def test_a_config_of_the_same_ratio_by_chance_keeps_other_gaussians(inputs, tmp_path):
    results = []
    for score in ("paper", "random"):
        config = PruneConfig(ratio=0.5, at="end", recovery=0, score=score)
        results.append(run(prune, config, inputs, tmp_path / score))
    assert results[0]["gaussians"] == results[1]["gaussians"]
    assert results[0]["validation_psnr_db"] > results[1]["validation_psnr_db"]


def test_evaluation_scores_exactly_what_it_wrote(inputs, tmp_path):
    out = tmp_path / "out"
    run(evaluate, EvaluateConfig(), inputs, out)
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["models"]) == {"base", "pruned"}
    for name, model in metrics["models"].items():
        assert set(model) >= {"psnr_db", "ssim", "gaussians", "bytes", "render_ms",
                              "train_seconds", "views"}
        assert [view["name"] for view in model["views"]] == [
            f"{i:06d}.png" for i in range(0, VIEWS, 4)]
        for view in model["views"]:
            shown = read_image(out / "renders" / name / view["name"], 48, 36)
            truth = read_image(out / "truth" / view["name"], 48, 36)
            original = inputs.folders["sfm"] / "undistorted" / "images" / view["name"]
            assert np.array_equal(truth, read_image(original, 48, 36))
            image = (shown / 255.0).astype(np.float32)
            assert view["psnr_8bit_db"] == pytest.approx(psnr(image, truth), abs=1e-5)
            # the saved render is rounded to 8 bits, the other scores are not
            assert view["psnr_db"] == pytest.approx(psnr(image, truth), abs=0.15)
            assert view["ssim"] == pytest.approx(ssim(image, truth), abs=0.01)
            assert view["ssim_padded"] == pytest.approx(ssim(image, truth, padded=True), abs=0.01)
        assert model["psnr_db"] == pytest.approx(
            np.mean([view["psnr_db"] for view in model["views"]]))
        assert model["bytes"] == (
            inputs.folders["train" if name == "base" else "prune"] / "splats.ply").stat().st_size
    assert metrics["models"]["base"]["psnr_db"] > mean_colour_psnr(inputs) + 2
    table = (out / "table.txt").read_text()
    assert "3DGS" in table
    assert "ours (pruned)" in table
    assert "scikit-image" in table
    assert "INRIA" in table
    assert "LPIPS: not measured" in table  # no test has its weights
    assert f"held out {metrics['models']['base']['psnr_db']:.2f} dB: a gap of" in table
    gained = [pruned["psnr_db"] - base["psnr_db"] for base, pruned in zip(
        *(metrics["models"][name]["views"] for name in ("base", "pruned")), strict=True)]
    assert metrics["pruned_minus_base"]["psnr_db"]["mean"] == pytest.approx(np.mean(gained))
    assert min(gained) <= metrics["pruned_minus_base"]["psnr_db"]["low"] <= np.mean(gained)
    assert "data set & PSNR 3DGS & PSNR ours" in (out / "metrics.tex").read_text()
    assert len((out / "metrics.csv").read_text().splitlines()) == 1 + 2 * (VIEWS // 4 + 1)


def test_views_that_training_saw_are_scored_beside_the_held_out_ones(inputs, tmp_path):
    run(evaluate, EvaluateConfig(), without(inputs, "prune"), tmp_path / "out")
    model = json.loads((tmp_path / "out" / "metrics.json").read_text())["models"]["base"]
    log = (inputs.folders["train"] / "log.jsonl").read_text().splitlines()
    assert model["seen_psnr_db"]["validation"] == pytest.approx(
        json.loads(log[-1])["validation_psnr_db"], abs=1e-3)
    assert model["seen_psnr_db"]["training"] > model["psnr_db"]


def test_scores_are_against_the_original_pixels_also_where_training_saw_denoised_ones(
    inputs, tmp_path
):
    folder = tmp_path / "sfm"
    shutil.copytree(inputs.folders["sfm"], folder)
    for path in (folder / "undistorted" / "denoised").iterdir():
        path.write_bytes((folder / "undistorted" / "denoised" / "000001.png").read_bytes())
    changed = StageInputs({**inputs.folders, "sfm": folder})
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "a")
    run(evaluate, EvaluateConfig(), changed, tmp_path / "b")
    first, second = (json.loads((tmp_path / name / "metrics.json").read_text())["models"]["base"]
                     for name in "ab")
    assert first["psnr_db"] == second["psnr_db"]


def test_without_pruning_there_is_one_model(inputs, tmp_path):
    run(evaluate, EvaluateConfig(), without(inputs, "prune"), tmp_path / "out")
    assert set(json.loads((tmp_path / "out" / "metrics.json").read_text())["models"]) == {"base"}


def test_a_held_out_frame_without_a_camera_is_named(inputs, tmp_path, caplog):
    folder = tmp_path / "ingest"
    shutil.copytree(inputs.folders["ingest"], folder)
    frames = json.loads((folder / "frames.json").read_text())
    frames["frames"].append({**frames["frames"][0], "name": "999999.png"})
    (folder / "frames.json").write_text(json.dumps(frames))
    summary = run(evaluate, EvaluateConfig(), StageInputs({**inputs.folders, "ingest": folder}),
                  tmp_path / "out")
    assert summary["unregistered_test"] == ["999999.png"]
    assert "999999.png" in caplog.text


def test_views_too_small_to_score_are_a_usage_error(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(held_out, "MIN_SIDE", 13)  # 16 pixels wide are 12 high here
    with pytest.raises(ConfigError, match="16x12 pixels are too small") as caught:
        run(evaluate, EvaluateConfig(max_size=16), inputs, tmp_path / "out")
    assert "--max-size" in caught.value.hint


def test_nothing_to_train_on_is_an_error(inputs, tmp_path):
    with pytest.raises(TrainingError, match="0 views"):
        run(train, CONFIG, holding_out(inputs, tmp_path, held_out=True), tmp_path / "out")


def test_nothing_to_score_on_is_an_error(inputs, tmp_path):
    with pytest.raises(ReconstructionError, match="No held-out view"):
        run(evaluate, EvaluateConfig(), holding_out(inputs, tmp_path, held_out=False),
            tmp_path / "out")


def holding_out(inputs, tmp_path, *, held_out):
    """The same inputs with every view held out, or none."""
    folder = tmp_path / "ingest"
    shutil.copytree(inputs.folders["ingest"], folder)
    frames = json.loads((folder / "frames.json").read_text())
    for frame in frames["frames"]:
        frame["held_out"] = held_out
    (folder / "frames.json").write_text(json.dumps(frames))
    return StageInputs({**inputs.folders, "ingest": folder})


def test_export_hands_out_the_pruned_model_where_there_is_one(inputs, tmp_path):
    summary = run(export, ExportConfig(), inputs, tmp_path / "a")
    assert summary["model"] == "pruned"
    assert (tmp_path / "a" / "splats.ply").read_bytes() == (
        inputs.folders["prune"] / "splats.ply").read_bytes()
    summary = run(export, ExportConfig(model="base"), inputs, tmp_path / "b")
    assert summary["gaussians"] == len(read_ply(inputs.folders["train"] / "splats.ply"))


def test_export_of_a_pruned_model_that_is_not_there_names_the_command(inputs, tmp_path):
    with pytest.raises(StageError) as caught:
        run(export, ExportConfig(model="pruned"), without(inputs, "prune"), tmp_path / "out")
    assert "recon prune" in caught.value.hint


def test_an_export_that_reads_back_differently_fails(inputs, tmp_path, monkeypatch):
    def lossy(path, splats):
        changed = splats.map(torch.clone)
        changed.means[0, 0] += 1e-3
        write_ply(path, changed)

    monkeypatch.setattr(export, "write_ply", lossy)
    with pytest.raises(Exception, match="reads back"):
        run(export, ExportConfig(), inputs, tmp_path / "out")


def test_a_checkpoint_cut_short_is_refused_with_what_to_type(inputs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stopping_after(7, patch)
        with pytest.raises(Killed):
            run(train, CONFIG, inputs, tmp_path / "out")
    path = tmp_path / "out" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(FormatError) as caught:
        run(train, CONFIG, inputs, tmp_path / "out")
    assert "--again" in caught.value.hint
