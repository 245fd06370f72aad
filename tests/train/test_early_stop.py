"""When a run that has flattened skips to its final phase, and that a resumed one does too."""

from dataclasses import replace
from functools import cache

import pytest
from tiny_task import CONFIG, STRATEGIES, Hooks, first_state, same, saved_and_loaded, tiny_task

from recon_cli.config.stages import RunConfig
from recon_cli.train.fit import loop as fitting
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule, next_iteration

PLAN = Schedule(RunConfig(iterations=1000))


def looks(*values, every=50):
    return [(every * (i + 1), value) for i, value in enumerate(values)]


FLAT = looks(*[20.0] * 20)
RISING = looks(*[20 + 0.02 * i for i in range(20)])


@pytest.mark.parametrize(("iteration", "expected"), [
    (300, None), (600, None), (650, 800), (750, 800), (800, None), (1000, None)])
def test_a_flat_run_jumps_after_densification_and_before_the_final_phase(iteration, expected):
    assert next_iteration(PLAN, iteration, FLAT[: iteration // 50]) == expected


def test_a_run_that_gains_two_hundredths_in_a_tenth_goes_on():
    assert next_iteration(PLAN, 700, RISING[:14]) is None


def test_a_run_whose_middle_is_not_kept_yet_goes_on():
    late = Schedule(RunConfig(iterations=1000, mid=0.7))
    assert next_iteration(late, 700, FLAT[:14]) is None
    assert next_iteration(late, 750, FLAT[:15]) == 800


def test_a_recipe_without_a_final_phase_jumps_to_its_last_fifth():
    plan = Schedule(RunConfig(iterations=1000, densify="reference"))
    assert next_iteration(plan, 700, FLAT[:14]) == 800


def test_without_looks_there_is_nothing_to_judge():
    assert next_iteration(PLAN, 700, []) is None


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_the_smallest_runs_never_jump(iterations):
    plan = Schedule(RunConfig(iterations=iterations))
    for iteration in range(1, iterations + 1):
        assert next_iteration(plan, iteration, [(1, 20.0), (2, 20.0)]) is None


@pytest.fixture
def flat(monkeypatch):
    """Reports every two steps of validation views that never change."""
    monkeypatch.setattr(fitting, "report_every", lambda _: 2)
    monkeypatch.setattr(fitting, "validation_psnr", lambda *_: 20.0)


def run(state, task, until=60):
    reports = []
    fit(state, task, until, (Hooks(on_report=reports.append),))
    return reports


@pytest.mark.integration
@pytest.mark.usefixtures("flat")
@pytest.mark.parametrize("config", [CONFIG, *STRATEGIES.values()])
def test_the_steps_between_are_not_taken_and_the_final_phase_is(config):
    state = first_state(config)
    reports = run(state, tiny_task(config))
    assert state.skipped_phase == (38, 48)
    assert (state.iteration, state.steps) == (60, 50)
    skips = {report.iteration: report.skip_to_iteration for report in reports}
    assert {at: to for at, to in skips.items() if to} == {38: 48}
    assert state.optimizer.count == 50


@cache
def whole_run():
    """The state after a run that was not interrupted; `flat` must be in force."""
    state = first_state()
    run(state, tiny_task())
    return state


@pytest.mark.integration
@pytest.mark.usefixtures("flat")
@pytest.mark.parametrize("stop", [17, 37, 38, 50])
def test_a_resumed_run_jumps_at_the_same_step_to_the_same_bits(tmp_path, stop):
    whole, part = whole_run(), first_state()
    run(part, tiny_task(), stop)
    resumed = saved_and_loaded(part, tmp_path)
    run(resumed, tiny_task())
    assert same(whole, resumed)
    assert resumed.skipped_phase == whole.skipped_phase
    assert resumed.validation_history == whole.validation_history


@pytest.mark.integration
@pytest.mark.usefixtures("flat")
def test_it_can_be_switched_off():
    config = replace(CONFIG, early_stop=False)
    state = first_state(config)
    run(state, tiny_task(config))
    assert (state.skipped_phase, state.steps) == (None, 60)


@pytest.mark.integration
def test_without_validation_views_a_run_takes_all_its_steps(monkeypatch):
    monkeypatch.setattr(fitting, "report_every", lambda _: 2)
    state, task = first_state(), replace(tiny_task(), validation=[])
    run(state, task)
    assert (state.skipped_phase, state.steps) == (None, 60)
