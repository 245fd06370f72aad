"""Steps of several views: the mean of their gradients, and all that goes with it."""

import dataclasses

import pytest
import torch
from tiny_task import CONFIG, STRATEGIES, first_state, same, saved_and_loaded, tiny_task

from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.stepper import Stepper

every_cpu_backend = pytest.mark.parametrize("backend", ["torch", "numba"])
every_strategy = pytest.mark.parametrize("name", STRATEGIES)


def with_batches(views, config=CONFIG):
    return dataclasses.replace(config, batch_views=views)


def run(state, task, until):
    fit(state, task, until)


def gradients_after_a_step(backend, views, monkeypatch, queue):
    """The optimizer's inputs, by name, and the state."""
    config = with_batches(views)
    state, task = first_state(config, backend=backend), tiny_task(config, backend=backend)
    state.queue, given = list(queue), {}

    def step(*_given, **_named):
        given.update({name: state.optimizer.gradient(name).clone()
                      for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc")})

    monkeypatch.setattr(state.optimizer, "step", step)
    Stepper(state, task, None).step()
    return given, state


@every_cpu_backend
def test_a_step_takes_the_mean_of_its_views_gradients(backend, monkeypatch):
    singles = [gradients_after_a_step(backend, 1, monkeypatch, [view])[0] for view in (0, 1, 3)]
    several, state = gradients_after_a_step(backend, 3, monkeypatch, [3, 1, 0])
    assert state.queue == []
    for name, value in several.items():
        mean = sum(one[name] for one in singles) / 3
        assert (value - mean).norm() <= 1e-6 * mean.norm(), name


@pytest.mark.integration
def test_backends_walk_the_same_way_in_steps_of_several_views():
    config, states = with_batches(3), {}
    for backend in ("torch", "numba"):
        states[backend] = first_state(config, backend=backend)
        run(states[backend], tiny_task(config, backend=backend), 9)
    for name, value in states["torch"].splats.parameters().items():
        other = getattr(states["numba"].splats, name)
        moved = (value - getattr(first_state().splats, name)).norm()
        assert (value - other).norm() <= 2e-4 * moved, name


@every_cpu_backend
def test_a_batch_of_the_same_view_moves_like_the_view_alone(backend):
    config = with_batches(2)
    twice, once = first_state(config, backend=backend), first_state(backend=backend)
    twice.queue, once.queue = [2, 2], [2]
    Stepper(twice, tiny_task(config, backend=backend), None).step()
    Stepper(once, tiny_task(backend=backend), None).step()
    # half and half of a number is the number, exactly
    assert same(twice, once)
    assert torch.equal(twice.gathered.count, 2 * once.gathered.count)
    assert torch.equal(twice.gathered.radius, once.gathered.radius)


@pytest.mark.integration
@every_cpu_backend
@every_strategy
def test_a_run_in_batches_learns_and_resumes_to_the_same_bits(tmp_path, backend, name):
    config = with_batches(3, STRATEGIES[name])
    task = tiny_task(config, backend=backend)
    whole, part = (first_state(config, backend=backend) for _ in range(2))
    run(whole, task, 30)
    run(part, task, 13)
    resumed = saved_and_loaded(part, tmp_path, backend=backend, config=config)
    run(resumed, task, 30)
    assert same(whole, resumed)
    assert not same(whole, first_state(config, backend=backend))


def test_a_batch_larger_than_the_capture_goes_through_several_epochs():
    config = with_batches(11)
    state = first_state(config, backend="numba")
    run(state, tiny_task(config, backend="numba"), 1)
    assert len(state.queue) == 1  # of three epochs of four
    assert (state.iteration, state.optimizer.count) == (1, 1)


@every_cpu_backend
def test_a_batch_with_a_loss_that_is_not_finite_comes_to_nothing(backend):
    config = with_batches(2)
    state, task = first_state(config, backend=backend), tiny_task(config, backend=backend)
    before = first_state(config, backend=backend)
    stepper, calls = Stepper(state, task, None), []
    compute = stepper._compute

    def second_fails(*given, **named):
        loss, statistics = compute(*given, **named)
        calls.append(loss)
        return (loss if len(calls) % 2 else float("nan")), statistics

    stepper._compute = second_fails
    stepper.step()
    assert same(state, before)
    assert (state.skipped, state.optimizer.count) == (1, 0)
    stepper._compute = compute
    before.iteration, before.queue = state.iteration, list(state.queue)
    stepper.step()  # and leaves no gradient behind
    Stepper(before, task, None).step()
    assert same(state, before)
    assert state.optimizer.count == before.optimizer.count == 1
