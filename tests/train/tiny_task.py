"""A training on a tiny scene of known truth, for the tests of the loop."""

import torch
from scenes import camera_at, random_splats, with_harmonics

from recon_cli.config.stages import RunConfig
from recon_cli.context import TrainCallback
from recon_cli.render import render
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.importance import Importance, add_views
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import load_state, new_state, save_state
from recon_cli.train.fit.task import Task

CONFIG = RunConfig(
    iterations=60, densify="reference", densify_every=10, densify_gradient=1e-5, max_gaussians=90,
    sh_rate=0.05)
STRATEGIES = {
    name: RunConfig(iterations=60, densify=name, densify_every=10, max_gaussians=90, sh_rate=0.05)
    for name in ("budget",)} | {"reference": CONFIG}
EXTENT = 1.0


class Hooks(TrainCallback):
    """Calls functions of a test."""

    def __init__(self, on_step=None, on_report=None, needs_step=lambda _: True):
        self._on_step, self._on_report, self._needs_step = on_step, on_report, needs_step

    def on_step(self, iteration, splats):
        if self._on_step:
            self._on_step(iteration, splats)

    def on_report(self, report):
        if self._on_report:
            self._on_report(report)

    def needs_step(self, iteration):
        return self._needs_step(iteration)


def tiny_task(config=CONFIG, device="cpu", backend="torch"):
    truth = random_splats(40, seed=0, dtype=torch.float32)
    views = []
    for i in range(5):
        camera = camera_at(40, 30, focal=30.0 + 2 * i)
        with torch.no_grad():
            rgb = render(truth, camera, torch.zeros(3), 0).rgb
        views.append(TrainView(camera, (rgb.clamp(0, 1) * 255).to(torch.uint8).numpy()))
    return Task(views[1:], views[:1], Schedule(config), EXTENT, backend, torch.device(device))


def first_state(config=CONFIG, device="cpu", backend="torch", *, colored=40):
    splats = with_harmonics(
        random_splats(40, seed=0, dtype=torch.float32), config.sh_degree, colored)
    splats.sh_dc = torch.zeros(40, 3)
    return new_state(splats.map(lambda tensor: tensor.to(device)), config, EXTENT,
                     backend=backend)


def saved_and_loaded(state, folder, device="cpu", backend="torch", config=CONFIG):
    """The state after a process that ended and another that began, maybe on another backend."""
    save_state(folder / "state.safetensors", state)
    return load_state(folder / "state.safetensors", config, EXTENT, torch.device(device),
                      backend=backend)


def same(a, b):
    return all(torch.equal(value, getattr(b.splats, name))
               for name, value in a.splats.parameters().items())


def importance_of(splats, views, *, sh_degree, backend):
    """All that a pass over views finds."""
    importance = Importance.zeros(len(splats), splats.means.device)
    add_views(importance, splats, views, sh_degree=sh_degree, backend=backend)
    return importance
