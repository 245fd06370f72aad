"""The sum over a schedule in closed form, and a calibration by a clock that is made up."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tiny_task import first_state, same, tiny_task

from recon_cli.config.stages import RunConfig
from recon_cli.time_estimate import Cost, TimeEstimator
from recon_cli.train.cost import REPORT, SAVE, calibrate, counts, list_work, step_kind
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule

FREE = Cost()


def run_seconds(schedule, first, *, steps=None, report=FREE, save=FREE):
    """The seconds of a run, by the costs of its steps by level; what is not given is free."""
    costs = {step_kind(level): (steps or {}).get(level, FREE) for level in (1, 2, 4)}
    costs |= {REPORT: report, SAVE: save}
    return TimeEstimator(costs).total(list_work(schedule, first, costs))


def plan(**changes):
    return Schedule(RunConfig(**{"iterations": 1000, "max_gaussians": 8000} | changes))


def test_a_fixed_cost_is_paid_at_each_step_of_its_level():
    for level, seconds in ((4, 0), (2, 4.0), (1, 6.0)):
        assert run_seconds(plan(), 2000, steps={level: Cost(0.01)}) == pytest.approx(
            seconds, rel=0.02)


def test_a_run_whose_count_stays_pays_for_it_at_every_step():
    steps = dict.fromkeys((1, 2, 4), Cost(each=0.001))
    assert run_seconds(plan(), 8000, steps=steps) == pytest.approx(8.0)
    assert run_seconds(plan(iterations=1), 8000, steps=steps) == pytest.approx(0.008)


def test_reports_and_checkpoints_are_counted():
    assert run_seconds(plan(), 8000, report=Cost(0.05)) == pytest.approx(0.5)
    saves = run_seconds(plan(checkpoint_every=100), 8000, save=Cost(each=0.002))
    assert saves == pytest.approx(0.16)


def test_long_checkpoints_take_a_tenth_of_the_steps():
    def seconds(count, **changes):
        return run_seconds(plan(**changes), count, steps=dict.fromkeys((1, 2, 4), Cost(0.003)),
                           save=Cost(each=0.05))

    # 8,000 Gaussians take .4 s to save, each hundred steps .3 s
    assert seconds(8000, checkpoint_every=100) == pytest.approx(3.3)
    # and where there are few it is not worth a thought
    assert seconds(8000, checkpoint_every=500) == pytest.approx(3.3)
    assert seconds(4000, checkpoint_every=1000, max_gaussians=4000) == pytest.approx(3.2)


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


@pytest.mark.integration
def test_what_every_step_takes_is_found_at_each_level_and_nothing_is_left_behind(tmp_path):
    clock = Ticks()
    found = calibrated(tmp_path, clock=clock)
    assert found.costs.keys() == {step_kind(2), step_kind(1), REPORT, SAVE}
    for level in (1, 2):
        assert found.costs[step_kind(level)].seconds(0.03) == pytest.approx(0.001)
        assert found.costs[step_kind(level)].each == pytest.approx(0.0, abs=1e-9)
    assert (found.threads, found.slowness) == (1, 1)  # what is timed here is as slow as it is here
    assert 0 < found.seconds < clock.now
    assert list(tmp_path.iterdir()) == []


def test_when_time_is_used_up_finer_levels_are_told_by_their_pixels(tmp_path):
    costs = calibrated(tmp_path, seconds=0.0).costs
    assert costs[step_kind(2)].fixed == pytest.approx(0.001)
    assert costs[step_kind(1)].fixed == pytest.approx(0.004)
    assert costs[REPORT].fixed == pytest.approx(0.004 / 3)


@pytest.mark.integration
def test_timing_changes_nothing_of_the_run(tmp_path):
    timed, plain = first_state(), first_state()
    task = tiny_task()
    calibrated(tmp_path, task=task)
    for state, given in ((timed, task), (plain, tiny_task())):
        fit(state, given, 30)
    assert same(timed, plain)


@pytest.mark.integration
def test_a_scene_without_validation_views_has_reports_that_cost_nothing(tmp_path):
    task = replace(tiny_task(RunConfig(iterations=60, max_gaussians=90)), validation=[])
    assert calibrated(tmp_path, task=task).costs[REPORT].seconds(0.09) == 0
