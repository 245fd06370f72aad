"""Pruning by rank, in rounds, and the rates of the recovery."""

import math

import numpy as np
import pytest
import torch
from scenes import camera_at, random_splats
from tiny_task import importance_of

from recon_cli.config.stages import PRUNE_SCORES, RunConfig
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.importance import RANDOM
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import RecoverySchedule, Schedule
from recon_cli.train.fit.state import new_state
from recon_cli.train.fit.task import Task
from recon_cli.train.prune.prune_loop import (
    LAST_ROUND,
    PruneRun,
    Removal,
    plan_removals,
    prune_loop,
    remaining,
    remove,
    rounds_within,
    survivors,
)

CONFIG = RunConfig(iterations=100, max_gaussians=40)


def task_of(count=5):
    rng = np.random.default_rng(0)
    views = [TrainView(camera_at(20 + i, 16), rng.integers(0, 256, (16, 20 + i, 3), np.uint8))
             for i in range(count)]
    return Task(views, [], RecoverySchedule(CONFIG, first=100, until=200), 1.0, "torch",
                torch.device("cpu"))


def state_of(splats=None):
    state = new_state(splats or random_splats(40, dtype=torch.float32), CONFIG, 1.0)
    state.iteration = 100
    return state


def run_of(task, state, score="loo", until=200):
    return PruneRun(state, task, 100, until, rounds=3, score=score)


def test_exactly_the_asked_count_stays_even_when_all_scores_are_equal():
    assert survivors(torch.ones(10), 7).tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_the_lowest_scores_go_and_the_order_of_the_rest_stays():
    assert survivors(torch.tensor([5.0, 1.0, 4.0, 2.0, 3.0]), 3).tolist() == [0, 2, 4]


@pytest.mark.parametrize("count", [0, 1])
def test_pruning_everything_leaves_the_most_significant_one(count):
    assert survivors(torch.tensor([1.0, 3.0, 2.0]), count).tolist() == [1]


def test_a_ratio_is_the_share_that_goes_and_one_always_stays():
    assert remaining(101, 0.66) == 101 - math.floor(0.66 * 101)
    assert remaining(10, 0.0) == 10
    assert remaining(10, 1.0) == 1
    assert remaining(1, 0.5) == 1


def test_rounds_remove_the_same_share_each_and_leave_the_rest_of_the_recovery_in_peace():
    plan = plan_removals(1000, 125, 3, 300)
    assert plan == (Removal(50, 500), Removal(100, 250), Removal(150, 125))
    assert plan[-1].after == LAST_ROUND * 300


def test_one_round_removes_all_at_once():
    assert plan_removals(1000, 200, 1, 300) == (Removal(0, 200),)


def test_there_is_a_round_an_epoch_within_bounds():
    assert rounds_within(800, 95) == 4
    assert rounds_within(0, 95) == 3
    assert rounds_within(10**6, 95) == 8


def test_rounds_that_would_remove_nothing_are_left_out():
    assert plan_removals(10, 10, 5, 100) == ()
    plan = plan_removals(10, 8, 5, 100)
    assert [removal.count for removal in plan] == sorted(
        {removal.count for removal in plan}, reverse=True)
    assert plan[-1].count == 8


def test_a_recovery_falls_as_a_run_does_and_moves_means_less_far():
    run, recovery = Schedule(CONFIG), RecoverySchedule(CONFIG, first=100, until=150)
    assert recovery.means_rate(100) == 0.7 * run.means_rate(0)
    assert recovery.means_rate(150) == pytest.approx(0.7 * run.means_rate(100))
    assert recovery.rate_factor(101) == 1
    assert recovery.rate_factor(150) == pytest.approx(run.rate_factor(100))


def test_a_recovery_looks_at_full_images_with_all_degrees_and_adds_nothing():
    recovery = RecoverySchedule(CONFIG, first=60, until=100)
    for iteration in range(61, 101):
        assert recovery.level(iteration) == 1
        assert recovery.sh_degree(iteration) == 3
        assert not recovery.densifies(iteration)
        assert not recovery.resets(iteration)


def test_removed_gaussians_are_gone_and_the_others_keep_their_moments():
    task, state = task_of(), state_of()
    fit(state, task, 103)
    means, moment = (state.optimizer.tensors()[name].clone()
                     for name in ("splats.means", "adam.means.exp_avg"))
    rows = torch.tensor([1, 5, 7])
    remove(state, rows)
    assert torch.equal(state.splats.means, means[rows])
    assert torch.equal(state.optimizer.tensors()["adam.means.exp_avg"], moment[rows])
    assert moment[rows].abs().max() > 0
    fit(state, task, 106)  # and training continues


@pytest.mark.parametrize("name", [*PRUNE_SCORES, RANDOM])
def test_scoring_takes_exactly_the_steps_that_it_was_given(name):
    task, state = task_of(), state_of()
    score = run_of(task, state, name).score(112)
    assert state.iteration == 112
    assert score.shape == (40,)
    assert (score >= 0).all()
    assert score.max() > 0


@pytest.mark.parametrize("steps", [0, 2, 5, 13])  # 13: more than an epoch, of which the last counts
def test_every_view_counts_once_however_few_or_many_steps_there_are(steps, monkeypatch):
    task, state = task_of(), state_of()
    monkeypatch.setattr(type(state.optimizer), "step", lambda *_, **__: None)  # nothing moves
    score = run_of(task, state, "loo").score(100 + steps)
    expected = importance_of(state.splats, task.train, sh_degree=3, backend="torch").loo
    assert torch.allclose(score, expected)


def test_the_loop_removes_in_rounds_and_trains_to_the_end():
    counts = []

    class Counted(PruneRun):
        def remove(self, score, count):
            super().remove(score, count)
            counts.append((self.state.iteration, len(self.state.splats)))

    task, state = task_of(), state_of()
    prune_loop(Counted(state, task, 100, 124, rounds=3), 5)
    assert counts == [(104, 20), (108, 10), (112, 5)]
    assert state.iteration == 124
