"""train, prune, evaluate and export on a tiny scene: their files, and resuming after a stop."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace

import pytest
import torch
from facts import raises
from killed import Killed, kill_after
from tiny_stages import CONFIG, CONTEXT, PRUNE, holding_out, mean_colour_psnr, run, without

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import PruneConfig, RunConfig
from recon_cli.context import TrainCallback
from recon_cli.errors import FormatError, StageError, TrainingError, WorkspaceError
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.stages import export, prune, train
from recon_cli.train import finished_model
from recon_cli.train.fit import runner

RUN = RunConfig(**{**vars(CONFIG), "max_size": 400, "sh_degree": 3})


@pytest.fixture
def inputs(tiny_pruned):
    """ingest, sfm, and a finished train and prune."""
    return tiny_pruned


def test_training_leaves_a_scene_its_states_and_a_log(inputs):
    folder = inputs.folders["train"]
    assert sorted(p.name for p in folder.iterdir()) == [
        "config.json", "final.safetensors", "log.jsonl", "mid.safetensors",
        "plan.json", "splats.ply"]
    rows = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert rows[-1]["iteration"] == 160
    assert rows[-1]["gaussians"] == len(read_ply(folder / "splats.ply"))
    assert rows[-1]["validation_psnr_db"] > mean_colour_psnr(inputs) + 2


@pytest.mark.integration
def test_two_runs_give_the_same_bytes(inputs, tmp_path):
    run(train, CONFIG, inputs, tmp_path / "again")
    for name in ("splats.ply", "mid.safetensors", "final.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (
            inputs.folders["train"] / name).read_bytes(), name


@pytest.mark.integration
@pytest.mark.parametrize("steps", [7, 91, 98])
def test_a_killed_training_ends_with_the_bytes_of_an_uninterrupted_one(
    inputs, tmp_path, monkeypatch, steps
):
    with monkeypatch.context() as patch:
        kill_after(steps, patch)
        with pytest.raises(Killed):
            run(train, CONFIG, inputs, tmp_path / "out")
    run(train, CONFIG, inputs, tmp_path / "out")
    for name in ("splats.ply", "mid.safetensors", "final.safetensors"):
        assert (tmp_path / "out" / name).read_bytes() == (
            inputs.folders["train"] / name).read_bytes(), name


@pytest.mark.integration
def test_ctrl_c_saves_the_state_and_training_goes_on_from_there(inputs, tmp_path, monkeypatch):
    recorded = []

    def press(done, total):
        recorded.append((done, total))

    original = runner.fit

    class Press(TrainCallback):
        def on_step(self, iteration, splats):  # noqa: ARG002
            if iteration == 10:
                os.kill(os.getpid(), signal.SIGINT)

    def fit_and_press(state, task, until, callbacks, *others):
        original(state, task, until, (Press(), *callbacks), *others)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "fit", fit_and_press)
        with pytest.raises(KeyboardInterrupt):
            run(train, CONFIG, inputs, tmp_path / "out", replace(CONTEXT, record=press))
    assert recorded[-1] == (10, 160)
    run(train, CONFIG, inputs, tmp_path / "out")
    assert (tmp_path / "out" / "splats.ply").read_bytes() == (
        inputs.folders["train"] / "splats.ply").read_bytes()


def test_pruning_at_mid_halves_the_count_and_both_models_saw_as_many_steps(inputs, tmp_path):
    summary = run(prune, PRUNE, inputs, tmp_path / "prune")
    assert summary.gaussians == summary.gaussians_before - summary.gaussians_before // 2
    assert summary.iterations == CONFIG.iterations
    assert summary.recovery_steps == 64
    assert len(read_ply(tmp_path / "prune" / "splats.ply")) == summary.gaussians
    assert (tmp_path / "prune" / "splats.ply").read_bytes() == (
        inputs.folders["prune"] / "splats.ply").read_bytes()
    assert (inputs.folders["train"] / "splats.ply").exists()


@pytest.mark.integration
def test_a_killed_recovery_ends_with_the_same_bytes(inputs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        kill_after(119, patch)
        patch.setattr(finished_model, "read_config", lambda _: RUN)  # checkpoints every 7 steps
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
    assert summary.recovery_steps == 0
    assert summary.train_seconds > 0


def test_a_config_of_the_same_ratio_by_chance_keeps_other_gaussians(inputs, tmp_path):
    results = []
    for score in ("loo", "paper"):
        config = PruneConfig(ratio=0.5, at="end", recovery=0, score=score)
        results.append(run(prune, config, inputs, tmp_path / score))
    assert results[0].gaussians == results[1].gaussians
    assert results[0].validation_psnr_db > results[1].validation_psnr_db


def test_nothing_to_train_on_is_an_error(inputs, tmp_path):
    with raises(TrainingError, 0, "views"):
        run(train, CONFIG, holding_out(inputs, tmp_path, held_out=True), tmp_path / "out")


def test_export_hands_out_the_pruned_model_where_there_is_one(inputs, tmp_path):
    summary = run(export, ExportConfig(backdrop="keep"), inputs, tmp_path / "a")
    assert summary.model == "pruned"
    assert (tmp_path / "a" / "splats.ply").read_bytes() == (
        inputs.folders["prune"] / "splats.ply").read_bytes()
    summary = run(export, ExportConfig(model="base"), inputs, tmp_path / "b")
    assert summary.gaussians == len(read_ply(inputs.folders["train"] / "splats.ply"))


def test_export_of_a_pruned_model_that_is_not_there_names_the_command(inputs, tmp_path):
    with pytest.raises(StageError) as caught:
        run(export, ExportConfig(model="pruned"), without(inputs, "prune"), tmp_path / "out")
    assert "recon prune" in caught.value.hint


def test_an_export_that_reads_back_differently_fails(inputs, tmp_path, monkeypatch):
    def lossy(path, splats, *extra, **comments):
        changed = splats.map(torch.clone)
        changed.means[0, 0] += 1e-3
        write_ply(path, changed, *extra, **comments)

    monkeypatch.setattr(export, "write_ply", lossy)
    with raises(WorkspaceError, "means"):
        run(export, ExportConfig(), inputs, tmp_path / "out")


def test_a_checkpoint_cut_short_is_refused_with_what_to_type(inputs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        kill_after(7, patch)
        with pytest.raises(Killed):
            run(train, CONFIG, inputs, tmp_path / "out")
    path = tmp_path / "out" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(FormatError) as caught:
        run(train, CONFIG, inputs, tmp_path / "out")
    assert "--again" in caught.value.hint


def test_large_checkpoints_take_no_more_than_a_tenth_of_the_time():
    now = [0.0]
    throttle = runner.CheckpointThrottle(lambda: now[0])

    def save(seconds):
        with throttle.saving():
            now[0] += seconds

    assert throttle.allows()
    save(0.2)  # soon written: as often as is asked for
    assert throttle.allows()
    save(0.5)
    assert not throttle.allows()
    now[0] += 4.9
    assert not throttle.allows()
    now[0] += 0.2
    assert throttle.allows()
