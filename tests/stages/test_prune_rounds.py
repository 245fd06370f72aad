"""prune in rounds: the limits, resuming after a kill, and one result for any number of threads."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from facts import assert_facts, raises
from tiny_scene import make_inputs

from recon_cli.config.stages import PRUNE_SCORES, PruneConfig, RunConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, TrainingError
from recon_cli.render.registry import use_threads
from recon_cli.scene.backdrop import SPHERE_GAUSSIANS
from recon_cli.splats.ply import read_ply
from recon_cli.stages import prune, train
from recon_cli.train import finished_model
from recon_cli.train.fit import runner
from recon_cli.train.fit.state import save_state
from recon_cli.train.prune import prune_run
from recon_cli.workspace.atomic import write_bytes

pytestmark = pytest.mark.integration

CONFIG = TrainConfig(
    iterations=120, densify_every=10, max_gaussians=120, sh_rate=0.05, checkpoint_every=3,
    validation=0.2)
RUN = RunConfig(**{**vars(CONFIG), "max_size": 400, "sh_degree": 3})
CONTEXT = StageContext(backend="numba")
THREE = PruneConfig(ratio=0.6, rounds=3, recovery=60)
SEARCH = PruneConfig(max_psnr_drop=1.0, rounds=3, recovery=30)


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill: nothing gets the chance to clean up."""


def run(config, inputs, out, ctx=CONTEXT):
    out.mkdir(exist_ok=True)
    return prune.run(config, inputs, out, ctx)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """ingest, sfm, and a finished train."""
    folder = tmp_path_factory.mktemp("tiny")
    given = make_inputs(folder)
    (folder / "train").mkdir()
    train.run(CONFIG, given, folder / "train", CONTEXT)
    return StageInputs({**given.folders, "train": folder / "train"})


@pytest.fixture(scope="module")
def whole(inputs, tmp_path_factory):
    """Runs that nothing interrupted, and their summaries."""
    folder = tmp_path_factory.mktemp("whole")
    return {config: (folder / str(i), run(config, inputs, folder / str(i)))
            for i, config in enumerate((THREE, SEARCH))}


def test_each_round_says_what_went_and_how_good_the_rest_is(whole):
    folder, summary = whole[THREE]
    counts = [one.gaussians for one in summary.rounds]
    assert counts == sorted(counts, reverse=True)
    assert len(counts) == 3
    assert counts[-1] == summary.gaussians == len(read_ply(folder / "splats.ply"))
    assert sum(one.removed for one in summary.rounds) == (
        summary.gaussians_before - summary.gaussians)
    assert all(one.validation_psnr_db > 5 for one in summary.rounds)
    assert summary.rounds[-1].validation_psnr_db == summary.validation_psnr_db
    assert json.loads((folder / "rounds.json").read_text())[0]["iteration"] == 130
    assert summary.recovery_steps == 60


def test_nothing_is_left_that_only_a_resumed_run_would_need(whole):
    for folder, _ in whole.values():
        assert sorted(path.name for path in folder.iterdir()) == [
            "log.jsonl", "rounds.json", "splats.ply"]


@pytest.mark.parametrize("config", [THREE, SEARCH], ids=["ratio", "search"])
def test_a_run_killed_anywhere_ends_with_the_same_bytes(
    config, inputs, whole, tmp_path, monkeypatch
):
    """Each time one write of a state or of the list succeeds more than the time before."""
    monkeypatch.setattr(finished_model, "read_config", lambda _: RUN)  # a checkpoint every 3 steps
    expected, summary = whole[config]
    kills = 0
    while True:
        writes = 0

        def count_and_die(write, *arguments, most=kills % 5 + 1):
            nonlocal writes
            write(*arguments)
            writes += 1
            if writes == most:
                raise Killed

        with monkeypatch.context() as patch:
            for module in (prune_run, runner):
                patch.setattr(module, "save_state", lambda *a: count_and_die(save_state, *a))
            patch.setattr(
                prune_run, "write_bytes", lambda *a: count_and_die(write_bytes, *a))
            try:
                resumed = run(config, inputs, tmp_path / "out")
                break
            except Killed:
                kills += 1
                assert kills < 300
    assert kills > 5
    for name in ("splats.ply", "rounds.json"):
        assert (tmp_path / "out" / name).read_bytes() == (expected / name).read_bytes()
    assert replace(resumed, train_seconds=0) == replace(summary, train_seconds=0)


def test_ctrl_c_while_scores_are_gathered_costs_no_byte_either(
    inputs, whole, tmp_path, monkeypatch
):
    original = runner.fit

    def interrupted(state, task, until, callbacks, importance):
        if importance is not None and state.iteration > 125:
            raise KeyboardInterrupt
        original(state, task, until, callbacks, importance)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "fit", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(THREE, inputs, tmp_path / "out")
    run(THREE, inputs, tmp_path / "out")
    assert (tmp_path / "out" / "splats.ply").read_bytes() == (
        whole[THREE][0] / "splats.ply").read_bytes()


def test_the_number_of_threads_changes_no_byte(inputs, tmp_path):
    pytest.importorskip("numba")
    config = PruneConfig(ratio=0.6, rounds=2, recovery=20)
    found = []
    for threads in (1, 2):
        use_threads("numba", threads)
        run(config, inputs, tmp_path / str(threads), replace(CONTEXT, backend="numba"))
        found.append((tmp_path / str(threads) / "splats.ply").read_bytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("score", PRUNE_SCORES)
def test_every_score_prunes(score, inputs, tmp_path):
    config = PruneConfig(ratio=0.5, score=score, rounds=2, recovery=4)
    summary = run(config, inputs, tmp_path / "out")
    assert summary.gaussians == summary.gaussians_before - summary.gaussians_before // 2


def test_at_most_so_many_gaussians_stay(inputs, tmp_path):
    few = run(PruneConfig(max_gaussians=17, recovery=0), inputs, tmp_path / "a")
    assert few.gaussians == 17
    summary = run(PruneConfig(max_gaussians=10**6, recovery=5), inputs, tmp_path / "b")
    assert summary.gaussians == summary.gaussians_before
    assert summary.rounds == ()


def test_the_ply_is_no_larger_than_asked_for_and_not_much_smaller(inputs, tmp_path):
    most = 10_000 + 248 * SPHERE_GAUSSIANS  # the backdrop's are not pruned
    run(PruneConfig(max_mb=most / 1e6, recovery=0), inputs, tmp_path / "out")
    size = (tmp_path / "out" / "splats.ply").stat().st_size
    assert most - 248 < size <= most


def test_a_ply_too_small_for_one_gaussian_is_refused(inputs, tmp_path):
    with raises(ConfigError, "max_mb", "0.0005"):
        run(PruneConfig(max_mb=0.0005), inputs, tmp_path / "out")


def test_pruning_everything_leaves_one(inputs, tmp_path):
    assert run(PruneConfig(ratio=1.0, recovery=2), inputs, tmp_path / "out").gaussians == 1


def test_the_search_ends_within_the_loss_that_it_was_allowed(whole):
    _, summary = whole[SEARCH]
    drop = summary.validation_psnr_db_before - summary.validation_psnr_db
    assert drop <= 1.0
    assert 0 < summary.gaussians < summary.gaussians_before
    tried = summary.rounds
    assert [one.kept for one in tried].count(False) >= 1  # more would have been too much
    last = [one for one in tried if one.kept][-1]
    assert last.gaussians == summary.gaussians
    assert last.validation_psnr_db == summary.validation_psnr_db
    for one in tried:
        good = summary.validation_psnr_db_before - one.validation_psnr_db <= 1.0
        assert one.kept == good


def test_where_every_removal_costs_too_much_nothing_goes(inputs, tmp_path, caplog, monkeypatch):
    # leaving some out may well be a gain: here each one costs
    monkeypatch.setattr(prune_run, "validation_psnr", lambda state, _: 0.1 * len(state.splats))
    config = PruneConfig(max_psnr_drop=0.0, score="paper", recovery=0)
    summary = run(config, inputs, tmp_path / "out")
    assert summary.gaussians == summary.gaussians_before
    assert not any(one.kept for one in summary.rounds)
    assert_facts(caplog.text, "removed")
    kept, before = (read_ply(folder / "splats.ply")
                    for folder in (tmp_path / "out", inputs.folders["train"]))
    assert np.array_equal(kept.means, before.means)


def test_a_loss_of_psnr_without_validation_views_is_refused(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(finished_model, "read_config", lambda _: replace(RUN, validation=0.0))
    with raises(TrainingError, "validation", "views") as caught:
        run(SEARCH, inputs, tmp_path / "out")
    assert "--validation" in caught.value.hint


def test_only_one_limit_may_be_given():
    with raises(ConfigError, "max_mb") as caught:
        PruneConfig(ratio=0.5, max_mb=3.0)
    assert "max_gaussians" in caught.value.hint


def test_a_loss_of_psnr_in_mid_training_is_refused():
    with raises(ConfigError, "finished", "model") as caught:
        PruneConfig(max_psnr_drop=0.5, at="mid")
    assert "recon prune" in caught.value.hint
