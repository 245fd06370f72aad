"""The sum over a schedule in closed form, and a calibration by a clock that is made up."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tiny_task import first_state, same, tiny_task

from recon_cli.config.stages import RunConfig
from recon_cli.train.cost import CostModel, LevelCost, calibrate, counts
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule

FREE = LevelCost(1, 0.0, 0.0)


def model(**levels):
    costs = {1: (0.0, 0.0), 2: (0.0, 0.0), 4: (0.0, 0.0)}
    costs |= {int(name[1:]): value for name, value in levels.items()}
    return CostModel(tuple(LevelCost(level, *cost) for level, cost in costs.items()), FREE, 0, 0)


def plan(**changes):
    return Schedule(RunConfig(**{"iterations": 1000, "max_gaussians": 8000} | changes))


def test_a_fixed_cost_is_paid_at_each_step_of_its_level():
    assert model(_4=(10.0, 0.0)).run_seconds(plan(), 2000) == 0
    assert model(_2=(10.0, 0.0)).run_seconds(plan(), 2000) == pytest.approx(4.0, rel=0.02)
    assert model(_1=(10.0, 0.0)).run_seconds(plan(), 2000) == pytest.approx(6.0, rel=0.02)


def test_a_run_whose_count_stays_pays_for_it_at_every_step():
    costs = model(_4=(0.0, 1.0), _2=(0.0, 1.0), _1=(0.0, 1.0))
    assert costs.run_seconds(plan(), 8000) == pytest.approx(8.0)
    assert costs.run_seconds(plan(iterations=1), 8000) == pytest.approx(0.008)


def test_reports_and_checkpoints_are_counted():
    reports = replace(model(), report=LevelCost(1, 50.0, 0.0))
    assert reports.run_seconds(plan(), 8000) == pytest.approx(0.5)
    saves = replace(model(), save_ms=2.0)
    assert saves.run_seconds(plan(checkpoint_every=100), 8000) == pytest.approx(0.16)


def test_long_checkpoints_take_a_tenth_of_the_steps():
    costs = replace(model(_4=(3.0, 0.0), _2=(3.0, 0.0), _1=(3.0, 0.0)), save_ms=50.0)
    # 8,000 Gaussians take .4 s to save, each hundred steps .3 s
    assert costs.run_seconds(plan(checkpoint_every=100), 8000) == pytest.approx(3.3)
    # and where there are few it is not worth a thought
    assert costs.run_seconds(plan(checkpoint_every=500), 8000) == pytest.approx(3.3)
    assert costs.run_seconds(plan(checkpoint_every=1000, max_gaussians=4000), 4000) == (
        pytest.approx(3.2))


@pytest.mark.parametrize("iterations", [1, 7, 99, 1000, 30_000])
def test_the_pieces_of_a_run_join_and_the_count_grows_to_its_cap(iterations):
    pieces = counts(plan(iterations=iterations), 2000)
    assert (pieces[0][0], pieces[-1][1]) == (0, iterations)
    assert all(a[1] == b[0] for a, b in pairwise(pieces))
    grown = [count for _, _, count in pieces]
    assert grown == sorted(grown)
    assert grown[0] == 2000
    assert grown[-1] == {1000: plan().target(500, 2000), 30_000: 8000}.get(iterations, 2000)


def test_a_count_at_its_cap_from_the_start_stays():
    assert {count for _, _, count in counts(plan(), 9000)} == {8000}


class Ticks:
    """A clock that advances by the same time whenever it is read."""

    def __init__(self, step=0.001):
        self.now, self.step = 0.0, step

    def __call__(self):
        self.now += self.step
        return self.now


def calibrated(tmp_path, *, seconds=100.0, clock=None, task=None):
    points = np.random.default_rng(0).normal((0, 0, 4), 1, (30, 3))
    return calibrate(
        task or tiny_task(RunConfig(iterations=60, max_gaussians=90)), points,
        np.full((30, 3), 128, np.uint8), scratch=tmp_path / "state", clock=clock or Ticks(),
        seconds=seconds)


def test_what_every_step_takes_is_found_at_each_level_and_nothing_is_left_behind(tmp_path):
    clock = Ticks()
    cost = calibrated(tmp_path, clock=clock)
    assert [level.level for level in cost.levels] == [1, 2]
    for level in cost.levels:
        assert level.ms(30) == pytest.approx(1.0)
        assert level.each_ms == pytest.approx(0.0, abs=1e-6)
    assert 0 < cost.seconds < clock.now
    assert list(tmp_path.iterdir()) == []


def test_when_time_is_used_up_finer_levels_are_told_by_their_pixels(tmp_path):
    cost = calibrated(tmp_path, seconds=0.0)
    fine, half = cost.levels
    assert half.fixed_ms == pytest.approx(1.0)
    assert fine.fixed_ms == pytest.approx(4.0)
    assert cost.report.fixed_ms == pytest.approx(4 / 3)


def test_timing_changes_nothing_of_the_run(tmp_path):
    timed, plain = first_state(), first_state()
    task = tiny_task()
    calibrated(tmp_path, task=task)
    for state, given in ((timed, task), (plain, tiny_task())):
        fit(state, given, 30)
    assert same(timed, plain)


def test_a_scene_without_validation_views_has_reports_that_cost_nothing(tmp_path):
    task = replace(tiny_task(RunConfig(iterations=60, max_gaussians=90)), validation=[])
    assert calibrated(tmp_path, task=task).report.ms(90) == 0
