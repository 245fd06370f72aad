"""The loop on a tiny scene of known truth: it learns, repeats itself, and resumes."""

from functools import cache

import numpy as np
import pytest
import torch
from facts import raises
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tiny_task import (
    CONFIG,
    EXTENT,
    STRATEGIES,
    Hooks,
    first_state,
    same,
    saved_and_loaded,
    tiny_task,
)

from recon_cli.config.stages import RunConfig
from recon_cli.errors import FormatError, TrainingError
from recon_cli.io.images import fill_masked
from recon_cli.kernels.thread_pool import pool
from recon_cli.render import available_backends, render
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.gradient import gradient_step
from recon_cli.train.fit.loop import fit, validation_psnr
from recon_cli.train.fit.state import load_state, save_state

RUNS = [(status.name, device) for status in available_backends() if not status.missing
        for device in status.devices]
every_run = pytest.mark.parametrize(("backend", "device"), RUNS)
every_strategy = pytest.mark.parametrize("config", STRATEGIES.values(), ids=STRATEGIES)
every_cpu_backend = pytest.mark.parametrize(
    "backend", [backend for backend, device in RUNS if device == "cpu"])


def masked_task(backend, device="cpu"):
    """The same views with a moving blot in each, which the masks ignore."""
    task = tiny_task(device=device, backend=backend)
    for views in (task.train, task.validation):
        for i, view in enumerate(views):
            mask = np.ones((30, 40), bool)
            mask[5:20, 4 + 5 * i:18 + 5 * i] = False
            views[i] = TrainView(view.camera, fill_masked(view.image, mask), mask)
    return task


def run(state, task, until, **hooks):
    fit(state, task, until, (Hooks(**hooks),))


@cache
def whole_run(backend, device, config):
    """The state after 45 steps that nothing interrupted; only looked at."""
    state = first_state(config, device, backend)
    run(state, tiny_task(config, device, backend), 45)
    return state


@pytest.mark.integration
@every_run
@every_strategy
def test_training_raises_the_psnr_of_a_view_that_it_never_sees(backend, device, config):
    state, task = first_state(config, device, backend), tiny_task(config, device, backend)
    before = validation_psnr(state, task)
    reports = []
    run(state, task, 60, on_report=reports.append)
    assert validation_psnr(state, task) > before + 3
    assert reports[-1].iteration == 60
    assert reports[-1].gaussians == len(state.splats) <= 90


@pytest.mark.integration
@every_run
def test_two_runs_with_one_seed_give_the_same_bits(backend, device):
    first, second = first_state(CONFIG, device, backend), first_state(CONFIG, device, backend)
    run(first, tiny_task(CONFIG, device, backend), 30)
    run(second, tiny_task(CONFIG, device, backend), 30)
    assert same(first, second)


@pytest.mark.integration
@every_strategy
def test_any_number_of_threads_trains_to_the_same_bits(monkeypatch, config):
    states = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(pool, "threads", threads)
        states.append(first_state(config, backend="numba"))
        run(states[-1], tiny_task(config, backend="numba"), 30)
    assert same(states[0], states[1])
    assert same(states[0], states[2])


def test_backends_walk_the_same_way():
    # densification decides by thresholds, and a decision that flips parts the ways for good: so
    # before the first one. Rounding grows from step to step; measured 2e-5 after nine.
    states = {}
    for backend in ("torch", "numba"):
        states[backend] = first_state(backend=backend)
        run(states[backend], tiny_task(backend=backend), 9)
    for name, value in states["torch"].splats.parameters().items():
        other = getattr(states["numba"].splats, name)
        moved = (value - getattr(first_state().splats, name)).norm()
        assert (value - other).norm() <= 2e-4 * moved, name


@pytest.mark.integration
def test_backends_walk_the_same_way_under_masks():
    states = {}
    for backend in ("torch", "numba"):
        states[backend] = first_state(backend=backend)
        run(states[backend], masked_task(backend), 9)
    for name, value in states["torch"].splats.parameters().items():
        other = getattr(states["numba"].splats, name)
        moved = (value - getattr(first_state().splats, name)).norm()
        assert (value - other).norm() <= 2e-4 * moved, name
    assert validation_psnr(states["torch"], masked_task("torch")) == pytest.approx(
        validation_psnr(states["numba"], masked_task("numba")), abs=1e-3)


@pytest.mark.integration
@every_run
def test_a_masked_run_that_goes_on_from_a_checkpoint_gives_the_same_bits(
    tmp_path, backend, device
):
    task = masked_task(backend, device)
    whole, part = (first_state(CONFIG, device, backend) for _ in range(2))
    run(whole, task, 45)
    run(part, task, 17)
    resumed = saved_and_loaded(part, tmp_path, device, backend)
    run(resumed, task, 45)
    assert same(whole, resumed)


def test_validation_scores_the_pixels_that_count():
    state, task = first_state(), masked_task("torch")
    view = task.validation[0]
    rgb = render(state.splats, view.camera, state.splats.background, 0).rgb.detach()
    rgb = rgb.clamp(0, 1).numpy()
    error = np.mean((rgb - view.image / 255.0)[view.mask] ** 2)
    assert validation_psnr(state, task) == pytest.approx(-10 * np.log10(error), abs=1e-4)


def test_another_seed_gives_another_result():
    first, second = first_state(), first_state(RunConfig(**{**vars(CONFIG), "seed": 1}))
    run(first, tiny_task(), 10)
    run(second, tiny_task(), 10)
    assert not same(first, second)


@pytest.mark.integration
@every_run
@every_strategy
@pytest.mark.parametrize("stop", [1, 17, 30])
def test_a_run_that_goes_on_from_a_checkpoint_gives_the_same_bits(
    tmp_path, stop, backend, device, config
):
    whole, task = whole_run(backend, device, config), tiny_task(config, device, backend)
    part = first_state(config, device, backend)
    run(part, task, stop)
    resumed = saved_and_loaded(part, tmp_path, device, backend, config)
    run(resumed, task, 45)
    assert same(whole, resumed)
    assert resumed.iteration == 45
    bytes_of = {}
    for name, state in (("whole", whole), ("resumed", resumed)):
        save_state(tmp_path / name, state)
        bytes_of[name] = (tmp_path / name).read_bytes()
    assert bytes_of["whole"] == bytes_of["resumed"]


@pytest.mark.integration
@every_run
@pytest.mark.parametrize(("degree", "colored"), [(0, 40), (1, 40), (2, 17), (3, 17), (3, 0)])
def test_a_run_in_which_only_some_have_harmonics_resumes_to_the_same_bits(
    tmp_path, degree, colored, backend, device
):
    config = RunConfig(**{**vars(CONFIG), "sh_degree": degree})
    task = tiny_task(config, device, backend)
    whole, part = (first_state(config, device, backend, colored=colored) for _ in range(2))
    run(whole, task, 25)
    run(part, task, 17)
    resumed = saved_and_loaded(part, tmp_path, device, backend)
    run(resumed, task, 25)
    assert same(whole, resumed)
    splats = whole.splats
    assert splats.sh_degree == degree
    assert len(splats) > 40  # densification added some, and those with coefficients came first
    assert (0 < len(splats.sh_rest) < len(splats)) == (0 < colored < 40)
    save_state(tmp_path / "whole", whole)
    save_state(tmp_path / "resumed", resumed)
    assert (tmp_path / "whole").read_bytes() == (tmp_path / "resumed").read_bytes()


@pytest.mark.integration
@pytest.mark.parametrize(("first", "second"), [("torch", "numba"), ("numba", "torch")])
def test_a_run_that_one_backend_began_goes_on_with_another(tmp_path, first, second):
    state = first_state(backend=first)
    run(state, tiny_task(backend=first), 25)
    halfway = validation_psnr(state, tiny_task(backend=first))
    resumed = saved_and_loaded(state, tmp_path, backend=second)
    assert same(state, resumed)
    task = tiny_task(backend=second)
    assert validation_psnr(resumed, task) == pytest.approx(halfway, abs=1e-3)
    run(resumed, task, 60)
    assert resumed.iteration == resumed.optimizer.count == 60
    assert validation_psnr(resumed, task) > halfway
    assert len(resumed.splats) <= 90


def test_a_truncated_checkpoint_is_refused(tmp_path):
    path = tmp_path / "state.safetensors"
    save_state(path, first_state())
    path.write_bytes(path.read_bytes()[:-100])
    with raises(FormatError):
        load_state(path, CONFIG, EXTENT, torch.device("cpu"))


def test_a_checkpoint_that_holds_nan_is_refused_when_read(tmp_path):
    path = tmp_path / "state.safetensors"
    save_state(path, first_state())
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors["splats.quats"][2, 1] = torch.nan
    save_file(tensors, path, metadata=metadata)
    with raises(TrainingError, "splats.quats"):
        load_state(path, CONFIG, EXTENT, torch.device("cpu"))


def test_a_state_that_diverged_is_not_saved_over_a_good_one(tmp_path):
    path = tmp_path / "state.safetensors"
    state = first_state()
    save_state(path, state)
    before = path.read_bytes()
    with torch.no_grad():
        state.splats.means[3] = torch.nan
    with raises(TrainingError, "diverged"):
        save_state(path, state)
    assert path.read_bytes() == before


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "state.safetensors"
    save_state(path, first_state())
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with raises(OSError, 28):
        save_state(path, first_state())
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["state.safetensors"]


@every_cpu_backend
def test_a_view_that_sees_nothing_does_not_stop_the_run(backend):
    task = tiny_task(backend=backend)
    blind = task.train[0]
    beyond = np.eye(4)
    beyond[2, 3] = -100  # everything lies behind the camera
    camera = type(blind.camera)(40, 30, 30.0, 30.0, 20.0, 15.0, beyond)
    task.train[:] = [TrainView(camera, blind.image)]
    state, first = first_state(backend=backend), first_state(backend=backend)
    run(state, task, 3)
    assert state.iteration == 3
    assert same(state, first)


@every_cpu_backend
def test_a_loss_that_stays_not_finite_stops_the_run(backend):
    state = first_state(backend=backend)
    with torch.no_grad():
        state.splats.sh_dc.fill_(3e38)  # colours overflow in the sum over fragments
    with raises(TrainingError, 6, 5, "finite"):
        run(state, tiny_task(backend=backend), 30)


@pytest.mark.integration
@every_cpu_backend
def test_one_step_whose_loss_is_not_finite_is_skipped_and_counted(backend, monkeypatch, tmp_path):
    state, task = first_state(backend=backend), tiny_task(backend=backend)
    before = state.splats.map(lambda tensor: tensor.detach().clone())
    compute = gradient_step(backend)
    monkeypatch.setattr(
        "recon_cli.train.fit.stepper.gradient_step",
        lambda *_: lambda *given, **named: (float("nan"), compute(*given, **named)[1]))
    run(state, task, 2)
    assert (state.iteration, state.skipped, state.optimizer.count) == (2, 2, 0)
    assert all(torch.equal(value, getattr(before, name))
               for name, value in state.splats.parameters().items())
    assert saved_and_loaded(state, tmp_path, backend=backend).skipped == 2
    monkeypatch.undo()
    run(state, task, 20)
    assert state.skipped == 2
    assert all(torch.isfinite(value).all() for value in state.splats.parameters().values())


@every_cpu_backend
@pytest.mark.parametrize("strategy", ["reference", "budget"])
def test_deleting_every_gaussian_is_an_error(backend, strategy):
    config = RunConfig(iterations=40, densify_every=10, min_opacity=1.0, densify=strategy)
    with raises(TrainingError, "Gaussian", "left"):
        run(first_state(config, backend=backend), tiny_task(config, backend=backend), 40)
