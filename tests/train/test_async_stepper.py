"""Steps that the host starts ahead of the device: the same bits, however far ahead, and no waiting.

Without a GPU in triton's interpreter, where a step takes about a second.
"""

import dataclasses

import pytest
import torch
from facts import raises
from interpreter import DEVICE
from scenes import camera_at, random_splats
from tiny_task import STRATEGIES, Hooks, same
from torch.utils._python_dispatch import TorchDispatchMode

from recon_cli.errors import TrainingError
from recon_cli.render import render
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit import stepper
from recon_cli.train.fit.importance import Importance
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import load_state, new_state, save_state
from recon_cli.train.fit.stepper import Stepper
from recon_cli.train.fit.task import Task
from recon_cli.train.parts.exposure import Exposure
from recon_cli.train.parts.photometry import Photometry

triton_step = pytest.importorskip(
    "recon_cli.render.triton.step", reason="triton is not installed")
Graphs = triton_step.Graphs

CONFIG = dataclasses.replace(STRATEGIES["budget"], densify_every=4, max_gaussians=30, sh_degree=1)
END, CHECKPOINT = 7, 5  # one densification, after step 4
COUNT = 16


def device_of(backend):
    return torch.device(DEVICE if backend == "triton" else "cpu")


def task_of(backend="triton", config=CONFIG):
    truth = random_splats(COUNT, seed=0, dtype=torch.float32)
    views = []
    for i in range(3):
        camera = camera_at(32, 16, focal=(24.0, 40.0, 16.0)[i])
        with torch.no_grad():
            rgb = render(truth, camera, torch.zeros(3), 0).rgb
        views.append(TrainView(camera, (rgb.clamp(0, 1) * 255).to(torch.uint8).numpy()))
    return Task(views, [], Schedule(config), 1.0, backend, device_of(backend))


def first(backend="triton", config=CONFIG):
    splats = random_splats(COUNT, seed=0, dtype=torch.float32)
    splats.sh_dc = torch.zeros(COUNT, 3)
    splats.sh_rest = torch.zeros(COUNT, 3, 3)
    splats = splats.map(lambda tensor: tensor.to(device_of(backend)))
    return new_state(splats, config, 1.0, backend=backend)


def run(state, task, until=END, *, looks=lambda _: False, on_step=None):
    fit(state, task, until, (Hooks(on_step, needs_step=looks),))


def held(state):
    """A copy of parameters, moments and counts by name."""
    return {name: value.cpu().clone() for name, value in state.optimizer.tensors().items()}


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        assert torch.equal(ours[name], value), name


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("ahead")


@pytest.fixture(scope="module")
def reference(folder):
    """Seven steps that meet the host after the densification, for a checkpoint, and at the end."""
    state, met = first(), []

    def on_step(iteration, _splats):
        met.append(iteration)
        if iteration == CHECKPOINT:
            save_state(folder / "state.safetensors", state)

    run(state, task_of(), looks=lambda now: now == CHECKPOINT, on_step=on_step)
    assert met == [4, CHECKPOINT, END]
    assert state.optimizer.count == END
    assert len(state.splats) > COUNT
    return held(state)


def with_step(monkeypatch, made, **options):
    """Lets steps be made with other options, and notes what becomes of them in `made`."""
    original = triton_step.PhotometricStep

    class Step(original):
        def __init__(self, device):
            super().__init__(device, **options)

        def close(self):
            made.append(super().close())
            return made[-1]

    monkeypatch.setattr(triton_step, "PhotometricStep", Step)


@pytest.mark.slow
def test_the_room_that_there_was_changes_no_bit(reference, monkeypatch):
    accounts = []
    with monkeypatch.context() as patch:
        with_step(patch, accounts)
        state = first()
        stepper = Stepper(state, task_of(), None)
        while state.iteration < END:
            stepper.step()
    assert_same(held(state), reference)  # step by step it is the same, too
    needed = [account.needed for account in accounts]
    assert len(needed) == END
    # the most that the steps before the first densification need, and one less
    for room, stopped in ((max(needed[:4]) - 1, needed.index(max(needed[:4]))), (1, 0)):
        accounts.clear()
        with monkeypatch.context() as patch:
            with_step(patch, accounts, room=room)
            state = first()
            run(state, task_of())
        assert accounts[0].stopped == stopped
        assert_same(held(state), reference)
    assert max(needed[:4]) > needed[0], "no run was stopped in mid-way"


@pytest.mark.slow
def test_recorded_launches_give_the_same_bits(reference, monkeypatch):
    played = []

    class Recorder:
        pools = 0

        def reset(self):
            self.pools += 1

        def __call__(self, work):
            def play():
                played.append(1)
                work()
            return play

    recorder = Recorder()
    with_step(monkeypatch, [], graphs=Graphs(recorder))
    state = first()
    run(state, task_of())
    assert played
    assert recorder.pools  # a densification changed all sizes
    assert_same(held(state), reference)


@pytest.mark.slow
def test_launches_that_cannot_be_recorded_are_started_one_by_one(reference, monkeypatch, caplog):
    def recorder(_):
        raise RuntimeError("operation not permitted when stream is capturing")

    with_step(monkeypatch, [], graphs=Graphs(recorder))
    state = first()
    run(state, task_of())
    assert caplog.text.count("without CUDA graphs") == 1
    assert_same(held(state), reference)


@pytest.mark.slow
def test_a_checkpoint_goes_on_to_the_same_bits(reference, folder):
    state = load_state(
        folder / "state.safetensors", CONFIG, 1.0, device_of("triton"), backend="triton")
    run(state, task_of())
    assert_same(held(state), reference)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_another_backend_goes_on_where_this_one_stopped(reference, folder, backend):
    state = load_state(
        folder / "state.safetensors", CONFIG, 1.0, torch.device("cpu"), backend=backend)
    run(state, task_of(backend))
    now = held(state)
    assert now["adam.count"] == reference["adam.count"]
    for name in state.splats.parameters():
        ours, theirs = now[f"splats.{name}"], reference[f"splats.{name}"]
        # rounding of two steps; a rate moves a mean by about 1e-3
        assert (ours - theirs).abs().max() <= 1e-5, name


@pytest.mark.slow
def test_this_backend_goes_on_where_another_one_stopped(reference, folder):
    state = first("numba")
    run(state, task_of("numba"), CHECKPOINT, looks=lambda _: True)
    save_state(folder / "numba.safetensors", state)
    state = load_state(
        folder / "numba.safetensors", CONFIG, 1.0, device_of("triton"), backend="triton")
    run(state, task_of())
    now = held(state)
    for name in state.splats.parameters():
        assert (now[f"splats.{name}"] - reference[f"splats.{name}"]).abs().max() <= 1e-4, name


def failing_at(monkeypatch, numbers):
    """Lets the loss of some steps be no number, counted from 1."""
    original, calls = triton_step.loss_and_gradient, []

    def loss(*given):
        calls.append(1)
        value, gradient = original(*given)
        return (value * torch.nan, gradient * torch.nan) if len(calls) in numbers else (
            value, gradient)

    monkeypatch.setattr(triton_step, "loss_and_gradient", loss)


@pytest.mark.slow
def test_a_loss_that_is_no_number_moves_nothing_and_is_counted(monkeypatch):
    states = []
    for step_by_step in (True, False):
        with monkeypatch.context() as patch:
            failing_at(patch, {2})
            state, task = first(), task_of()
            if step_by_step:
                stepper = Stepper(state, task, None)
                for _ in range(3):
                    stepper.step()
            else:
                run(state, task, 3)
            states.append(state)
    assert [(state.iteration, state.skipped, state.optimizer.count) for state in states] == [
        (3, 1, 2)] * 2
    assert same(*states)
    assert torch.equal(states[0].gathered.variance, states[1].gathered.variance)
    assert torch.equal(states[0].gathered.count, states[1].gathered.count)


@pytest.mark.slow
def test_losses_that_stay_no_number_end_the_run(monkeypatch):
    failing_at(monkeypatch, set(range(1, 20)))
    with raises(TrainingError, "finite"):
        run(first(), task_of(), 20)


class NoWaiting(TorchDispatchMode):
    """Refuses what makes the host wait for a device, wherever the tensors are."""

    WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal")

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        assert name not in self.WAITS, f"{name} waits for the device"
        if name in ("index", "index_put_"):
            assert not any(one is not None and one.dtype == torch.bool for one in args[1]), name
        return function(*args, **(kwargs or {}))


@pytest.mark.slow
def test_steps_of_several_views_go_ahead_to_the_same_bits(monkeypatch):
    config = dataclasses.replace(CONFIG, batch_views=2)
    failing, states, accounts = {5}, [], []  # the third step comes to nothing
    for room in (None, 1000, 12):
        with monkeypatch.context() as patch:
            with_step(patch, accounts, room=room)
            failing_at(patch, failing if room != 12 else set())
            state, task = first(config=config), task_of(config=config)
            if room is None:
                stepper = Stepper(state, task, None)
                for _ in range(5):
                    stepper.step()
            else:
                accounts.clear()
                run(state, task, 5)
            states.append(state)
    one_by_one, ahead_of, stopped = states
    assert (ahead_of.skipped, ahead_of.optimizer.count) == (1, 4)
    assert one_by_one.skipped == 1
    assert_same(held(ahead_of), held(one_by_one))
    for name, value in vars(one_by_one.gathered).items():
        assert torch.equal(getattr(ahead_of.gathered, name), value), name
    # a step that was stopped at its second view is taken again as a whole
    assert any((account.stopped or 0) % 2 for account in accounts)
    with monkeypatch.context() as patch:
        with_step(patch, [], room=1000)
        state = first(config=config)
        run(state, task_of(config=config), 5)
    assert_same(held(stopped), held(state))


@pytest.mark.integration
@pytest.mark.parametrize("views", [1, 2])
def test_a_step_never_waits_for_the_device(views):
    config = dataclasses.replace(CONFIG, batch_views=views)
    state, task = first(config=config), task_of(config=config)
    steps = stepper.AsyncStepper(state, task, lambda _: False)
    steps._start()
    with NoWaiting():
        steps._start()
        with raises(AssertionError, "waits"):
            float(state.splats.means.detach()[0, 0])


def test_whoever_must_know_more_after_each_step_takes_them_one_by_one():
    def chosen(backend="triton", importance=None, *, exposure=False, **changes):
        config = dataclasses.replace(CONFIG, **changes)
        state, task = first(backend, config), task_of(backend, config)
        state.photometry = Photometry([Exposure(3)]) if exposure else None
        found = stepper.choose_stepper(state, task, importance, lambda _: False)
        return type(found.__self__)

    assert chosen() is stepper.AsyncStepper
    assert chosen("numba") is Stepper
    assert chosen(importance=Importance.zeros(COUNT, torch.device("cpu"))) is Stepper
    assert chosen(exposure=True) is Stepper
    assert chosen(batch_views=2) is stepper.AsyncStepper
