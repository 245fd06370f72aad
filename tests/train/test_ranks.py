"""Training by several processes, real ones, connected by gloo on this machine."""

import dataclasses

import numpy as np
import pytest
import torch
from team import team
from tiny_task import CONFIG, STRATEGIES, first_state, same, saved_and_loaded, tiny_task

from recon_cli.errors import TrainingError
from recon_cli.train.fit import fit
from recon_cli.train.importance import Importance
from recon_cli.train.initialize import new_exposure
from recon_cli.train.schedule import RecoverySchedule

pytestmark = pytest.mark.integration

every_cpu_backend = pytest.mark.parametrize("backend", ["torch", "numba"])
every_strategy = pytest.mark.parametrize("name", STRATEGIES)
two = pytest.mark.parametrize("others", [2], indirect=True)
three = pytest.mark.parametrize("others", [3], indirect=True)
# Sums of single precision in another order differ by 1e-7 of the largest; Adam divides gradients by
# their size, and so may hand that on undiminished, a step of a Gaussian after the other.
BEFORE = 1e-5  # of the way that the parameters went, before Gaussians are added
AFTER = 1e-2


@pytest.fixture(scope="module")
def others(request, tmp_path_factory):
    """The leader's end of two or three processes."""
    with team(request.param, tmp_path_factory.mktemp("team")) as found:
        yield found


def batched(views, config=CONFIG, **changes):
    return dataclasses.replace(config, batch_views=views, **changes)


def alone(state, task, until, importance=None):
    fit(state, task, until, importance=importance)


def assert_near(state, other, config, share):
    """Asserts that two runs went the same way, up to a share of its length."""
    assert len(state.splats) == len(other.splats)
    assert (state.iteration, state.queue) == (other.iteration, other.queue)
    first = first_state(config).splats.parameters()
    for name, value in state.splats.parameters().items():
        theirs = getattr(other.splats, name)
        way = (theirs - first[name]).norm() if len(theirs) == len(first[name]) else theirs.norm()
        assert (value - theirs).norm() <= share * way, name


@two
@every_cpu_backend
@every_strategy
def test_processes_with_a_view_each_go_the_way_of_one_with_all_their_views(others, backend, name):
    config = batched(2, STRATEGIES[name])
    mine, single = (first_state(config, backend=backend) for _ in range(2))
    for until, share in ((9, BEFORE), (36, AFTER)):
        others.fit(mine, tiny_task(config, backend=backend), until)
        alone(single, tiny_task(config, backend=backend), until)
        assert_near(mine, single, config, share)
        assert others.others_hold(mine)
    assert len(mine.splats) > 40


@two
@every_cpu_backend
def test_the_same_processes_give_the_same_bits_again_and_after_an_interruption(
    others, backend, tmp_path
):
    config = batched(2, STRATEGIES["budget"])
    whole, again = (first_state(config, backend=backend) for _ in range(2))
    others.fit(whole, tiny_task(config, backend=backend), 30)
    others.fit(again, tiny_task(config, backend=backend), 13)
    again = saved_and_loaded(again, tmp_path, backend=backend, config=config)
    others.fit(again, tiny_task(config, backend=backend), 30)
    assert same(whole, again)
    assert others.others_hold(whole)


@two
def test_shares_may_be_uneven(others):
    config = batched(3)
    mine, single = (first_state(config, backend="numba") for _ in range(2))
    others.fit(mine, tiny_task(config, backend="numba"), 31)
    alone(single, tiny_task(config, backend="numba"), 31)
    assert_near(mine, single, config, AFTER)
    assert others.others_hold(mine)


@two
def test_gains_and_masks_are_those_of_one_process(others):
    config = batched(2, exposure="on")
    task = tiny_task(config, backend="numba")
    mask = np.arange(30 * 40).reshape(30, 40) % 7 > 0
    task.train[1] = dataclasses.replace(task.train[1], mask=mask)
    states = [first_state(config, backend="numba") for _ in range(2)]
    for state in states:
        state.exposure = new_exposure(task)
    mine, single = states
    others.fit(mine, task, 24)
    alone(single, task, 24)
    assert_near(mine, single, config, AFTER)
    assert np.abs(single.exposure.log_gains).max() > 1e-3
    assert mine.exposure.log_gains == pytest.approx(single.exposure.log_gains, abs=1e-6)
    assert others.others_hold(mine)


@two
def test_a_jump_is_taken_by_all(others):
    config = batched(2, CONFIG, iterations=300, densify_every=1000)
    task = dataclasses.replace(tiny_task(config, backend="numba"), jump=(100, 280))
    mine, single, reports = first_state(config, backend="numba"), first_state(
        config, backend="numba"), []
    others.fit(mine, task, 290, on_report=reports.append)
    alone(single, task, 290)
    assert (mine.steps, mine.jump) == (110, (100, 280))
    assert_near(mine, single, config, AFTER)
    assert others.others_hold(mine)
    assert [one.goes_on_at for one in reports] == [280, None]


@two
def test_scores_of_all_processes_are_added_to_those_that_were_there(others):
    config = batched(2)
    task = dataclasses.replace(tiny_task(config, backend="numba"), schedule=RecoverySchedule(
        config, first=0, until=10))
    found = {}
    for who, run in (("all", others.fit), ("one", alone)):
        state, found[who] = first_state(config, backend="numba"), Importance.zeros(
            40, torch.device("cpu"))
        run(state, task, 2, importance=found[who])
        run(state, task, 4, importance=found[who])
    assert found["all"].views == found["one"].views == 8
    assert found["one"].hits.sum() > 0
    assert torch.equal(found["all"].hits, found["one"].hits)
    assert torch.equal(found["all"].blend_max, found["one"].blend_max)
    assert torch.allclose(found["all"].blend_sum, found["one"].blend_sum, rtol=1e-6)
    assert torch.allclose(found["all"].loo, found["one"].loo, rtol=1e-5)


@two
def test_what_stops_the_leader_between_two_steps_leaves_the_others_waiting(others, tmp_path):
    config = batched(2)
    mine, single = (first_state(config, backend="numba") for _ in range(2))

    def press(iteration, _splats):
        if iteration == 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        others.fit(mine, tiny_task(config, backend="numba"), 30, on_step=press)
    assert mine.iteration == 13
    assert others.others_hold(mine)
    resumed = saved_and_loaded(mine, tmp_path, backend="numba", config=config)
    alone(resumed, tiny_task(config, backend="numba"), 30)  # one process goes on,
    alone(single, tiny_task(config, backend="numba"), 13)  # and what one began, two
    others.fit(single, tiny_task(config, backend="numba"), 30)
    assert_near(resumed, single, config, AFTER)


@two
def test_what_all_processes_meet_in_a_step_leaves_them_waiting(others):
    config = batched(2, min_opacity=1.0)
    with pytest.raises(TrainingError, match="No Gaussian is left"):
        others.fit(first_state(config), tiny_task(config), 30)
    state = first_state(batched(2))
    others.fit(state, tiny_task(batched(2)), 3)
    assert others.others_hold(state)


@two
@pytest.mark.parametrize("densify_every", [10, 1000])
def test_processes_that_part_are_stopped(others, densify_every):
    config = batched(2, densify_every=densify_every, max_gaussians=40)
    state = first_state(config)

    def spoil(iteration, splats):
        if iteration == 3:
            with torch.no_grad():
                splats.means[7, 1] *= 1 + 1e-6

    with pytest.raises(TrainingError, match="hold different Gaussians"):
        others.fit(state, tiny_task(config), 20, on_step=spoil)
    assert state.iteration == min(20, densify_every)
    others.fit(first_state(config), tiny_task(config), 3)


@three
def test_a_process_may_have_no_view_of_a_step(others):
    config = batched(2)
    mine, single = (first_state(config, backend="numba") for _ in range(2))
    others.fit(mine, tiny_task(config, backend="numba"), 31)
    alone(single, tiny_task(config, backend="numba"), 31)
    assert_near(mine, single, config, AFTER)
    assert others.others_hold(mine)
