"""The loop on a tiny scene of known truth: it learns, repeats itself, and goes on where it was."""

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from scenes import camera_at, random_splats

from recon_cli.config import TrainConfig
from recon_cli.errors import FormatError, TrainingError
from recon_cli.render import render
from recon_cli.train.fit import Task, fit, validation_psnr
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import load_state, new_state, save_state
from recon_cli.train.step import TrainView

CONFIG = TrainConfig(
    iterations=60, densify_every=10, densify_gradient=1e-5, max_gaussians=90, sh_rate=0.05)
EXTENT = 1.0


DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def tiny_task(config=CONFIG, device="cpu"):
    truth = random_splats(40, seed=0, dtype=torch.float32)
    views = []
    for i in range(5):
        camera = camera_at(40, 30, focal=30.0 + 2 * i)
        with torch.no_grad():
            rgb = render(truth, camera, torch.zeros(3), 0).rgb
        views.append(TrainView(camera, (rgb.clamp(0, 1) * 255).to(torch.uint8).numpy()))
    return Task(views[1:], views[:1], Schedule(config), EXTENT, "torch", torch.device(device))


def first_state(config=CONFIG, device="cpu"):
    splats = random_splats(40, seed=0, dtype=torch.float32)
    splats.sh_dc = torch.zeros(40, 3)
    return new_state(splats.map(lambda tensor: tensor.to(device)), config, EXTENT)


def run(state, task, until, **hooks):
    fit(state, task, until, on_step=hooks.get("on_step", lambda _: None),
        on_report=hooks.get("on_report", lambda _: None))


def same(a, b):
    return all(torch.equal(value, getattr(b.splats, name))
               for name, value in a.splats.parameters().items())


@pytest.mark.parametrize("device", DEVICES)
def test_training_raises_the_psnr_of_a_view_that_it_never_sees(device):
    state, task = first_state(device=device), tiny_task(device=device)
    before = validation_psnr(state, task)
    reports = []
    run(state, task, 60, on_report=reports.append)
    assert validation_psnr(state, task) > before + 3
    assert reports[-1].iteration == 60
    assert reports[-1].gaussians == len(state.splats) <= 90


@pytest.mark.parametrize("device", DEVICES)
def test_two_runs_with_one_seed_give_the_same_bits(device):
    first, second = first_state(device=device), first_state(device=device)
    run(first, tiny_task(device=device), 30)
    run(second, tiny_task(device=device), 30)
    assert same(first, second)


def test_another_seed_gives_another_result():
    first, second = first_state(), first_state(TrainConfig(**{**vars(CONFIG), "seed": 1}))
    run(first, tiny_task(), 10)
    run(second, tiny_task(), 10)
    assert not same(first, second)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("stop", [1, 17, 30])
def test_a_run_that_goes_on_from_a_checkpoint_gives_the_same_bits(tmp_path, stop, device):
    whole, task = first_state(device=device), tiny_task(device=device)
    run(whole, task, 45)
    part = first_state(device=device)
    run(part, task, stop)
    save_state(tmp_path / "state.safetensors", part)
    resumed = load_state(tmp_path / "state.safetensors", CONFIG, EXTENT, torch.device(device))
    run(resumed, task, 45)
    assert same(whole, resumed)
    assert resumed.iteration == 45


def test_a_truncated_checkpoint_is_refused(tmp_path):
    path = tmp_path / "state.safetensors"
    save_state(path, first_state())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(FormatError, match="cannot be read"):
        load_state(path, CONFIG, EXTENT, torch.device("cpu"))


def test_a_checkpoint_that_holds_nan_is_refused_when_read(tmp_path):
    path = tmp_path / "state.safetensors"
    save_state(path, first_state())
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors["splats.quats"][2, 1] = torch.nan
    save_file(tensors, path, metadata=metadata)
    with pytest.raises(TrainingError, match=r"damaged: splats\.quats holds values"):
        load_state(path, CONFIG, EXTENT, torch.device("cpu"))


def test_a_state_that_diverged_is_not_saved_over_a_good_one(tmp_path):
    path = tmp_path / "state.safetensors"
    state = first_state()
    save_state(path, state)
    before = path.read_bytes()
    with torch.no_grad():
        state.splats.means[3] = torch.nan
    with pytest.raises(TrainingError, match="diverged"):
        save_state(path, state)
    assert path.read_bytes() == before


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "state.safetensors"
    save_state(path, first_state())
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_state(path, first_state())
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["state.safetensors"]


def test_a_view_that_sees_nothing_does_not_stop_the_run():
    task = tiny_task()
    blind = task.train[0]
    turned = blind.camera.viewmat.copy()
    turned[:3, :3] = np.diag([-1.0, 1, -1]) @ turned[:3, :3]
    camera = type(blind.camera)(40, 30, 30.0, 30.0, 20.0, 15.0, turned)
    task.train[:] = [TrainView(camera, blind.image)]
    state = first_state()
    run(state, task, 3)
    assert state.iteration == 3


def test_deleting_every_gaussian_is_an_error():
    config = TrainConfig(iterations=40, densify_every=10, min_opacity=1.0)
    with pytest.raises(TrainingError, match="No Gaussian is left"):
        run(first_state(config), tiny_task(config), 40)
