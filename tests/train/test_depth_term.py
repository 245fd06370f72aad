"""Sensor depth in a training step: exact gradients, surfaces where the sensor sees them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import camera_at, random_splats
from tiny_task import STRATEGIES, first_state, same, saved_and_loaded, tiny_task
from wall_scene import CONFIG as WALL_CONFIG
from wall_scene import scene as wall_scene

from recon_cli.config.stages import RunConfig
from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.render.depth_loss import depth_loss
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.train_view import SensorDepth, TrainView
from recon_cli.train.fit.gradient import RENDERED_NOISE, gradient_step, photometric_loss
from recon_cli.train.fit.initialize import first_state as begin_at
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule, make_schedule
from recon_cli.train.fit.state import new_state
from recon_cli.train.parts.table import step_options
from recon_cli.train.parts.trials import examine

# Gradients of float32 against float64, relative in the 2-norm, as in test_gradient.
TOLERANCE = 1e-5
WEIGHT = 0.005
CAMERA = camera_at(60, 41)
every_cpu_backend = pytest.mark.parametrize("backend", ["torch", "numba"])


def sensor(camera, depths, noise=0.01, step=2):
    """Samples of every second pixel of a depth image [H, W], 0 where it is not known."""
    row, column = np.mgrid[0:camera.height:step, 0:camera.width:step].reshape(2, -1)
    z = np.asarray(depths, np.float32)[row, column]
    rays = np.stack([(column + 0.5 - camera.cx) / camera.fx,
                     (row + 0.5 - camera.cy) / camera.fy], 1).astype(np.float32)
    return SensorDepth(rays[z > 0], z[z > 0], noise, len(row))


def view_with(depths, mask=None):
    image = np.random.default_rng(0).integers(0, 256, (41, 60, 3), np.uint8)
    return TrainView(CAMERA, image, mask, depth=sensor(CAMERA, depths))


def depths_with_holes():
    depths = np.random.default_rng(1).uniform(1.5, 4, (41, 60)).astype(np.float32)
    depths[10:20] = 0
    return depths


def step_on(splats, view, backend, gain=None):
    state = new_state(splats, RunConfig(iterations=10, max_gaussians=300), 1.0, backend=backend)
    loss, _ = gradient_step(backend)(
        state.optimizer, view, StepOptions(3, 0.2, depth_weight=WEIGHT), gain)
    held = state.optimizer.gradients.parameters().items()
    if not state.optimizer.fused:
        held = ((name, leaf.grad) for name, leaf in state.splats.parameters().items())
    return loss, {name: value.clone() for name, value in held}


def exact(splats, view):
    """The same in float64 by autograd, over every pixel."""
    leaves = splats.map(lambda tensor: tensor.detach().double().requires_grad_())
    out = render(leaves, view.camera, leaves.background, 3, backend="torch")
    counting = view.counting(torch.device("cpu"))
    truth = torch.from_numpy(view.depth.image(view.camera, view.mask)).double()
    loss = photometric_loss(
        out.rgb, torch.from_numpy(view.image).double() / 255, 0.2, mask=counting) + depth_loss(
        out.depth, out.alpha, truth, np.hypot(view.depth.noise, RENDERED_NOISE),
        WEIGHT / view.depth.cells)
    loss.backward()
    return loss.item(), {name: leaf.grad for name, leaf in leaves.parameters().items()}


@pytest.mark.parametrize("masked", [False, True])
@every_cpu_backend
def test_a_step_with_depth_gives_the_gradients_of_its_loss(backend, masked):
    splats = random_splats(200, seed=13, dtype=torch.float32)
    mask = np.arange(60 * 41).reshape(41, 60) % 7 > 0 if masked else None
    view = view_with(depths_with_holes(), mask)
    loss, gradients = step_on(splats, view, backend)
    true_loss, expected = exact(splats, view)
    plain, without = step_on(splats, replace(view, depth=None), backend)
    assert loss == pytest.approx(true_loss, abs=1e-6)
    assert loss > plain + 1e-4  # it matters here
    for name, value in gradients.items():
        theirs = expected[name]
        assert (value.double() - theirs).norm() <= TOLERANCE * theirs.norm(), name
    assert (gradients["means"] - without["means"]).norm() > 1e-2 * without["means"].norm()


@every_cpu_backend
def test_depth_that_is_nowhere_known_changes_no_gradient(backend):
    splats = random_splats(200, seed=13, dtype=torch.float32)
    view = view_with(np.zeros((41, 60)))
    _, gradients = step_on(splats, view, backend)
    _, without = step_on(splats, replace(view, depth=None), backend)
    for name, value in gradients.items():
        torch.testing.assert_close(value, without[name], rtol=0, atol=1e-9)


def test_samples_fall_into_the_pixels_of_any_size_and_none_under_a_mask():
    depths = np.arange(1, 41 * 60 + 1).reshape(41, 60)
    one = sensor(CAMERA, depths, step=1)
    np.testing.assert_array_equal(one.image(CAMERA), depths)
    half = one.image(CAMERA.resized(30, 20))
    assert (half > 0).all()
    assert half[0, 0] in depths[:3, :2]
    mask = np.ones((41, 60), bool)
    mask[5] = False
    np.testing.assert_array_equal(one.image(CAMERA, mask), np.where(mask, depths, 0))


def blank_wall(depth):
    """The task of a wall of one grey, which images alone do not place, and its Gaussians."""
    scene = wall_scene(config=replace(
        WALL_CONFIG, depth=depth, iterations=300, background="off", stereo="off", exposure="off",
        means_rate=3e-3))
    grey = [TrainView(view.camera, np.full_like(view.image, 128),
                      depth=sensor(view.camera, np.full(view.image.shape[:2], 2.0)))
            for view in scene.task.train]
    task = replace(scene.task, train=grey)
    points = scene.points * (1, 1, 1.1)  # behind the wall
    return task, points, np.full((len(points), 3), 128, np.uint8)


@pytest.mark.integration
def test_a_blank_wall_comes_to_where_the_sensor_sees_it():
    off = {}
    for depth in ("off", "on"):
        task, points, colors = blank_wall(depth)
        state = begin_at(task, points, colors, most=2000)
        fit(state, task, 300)
        surface = render_surface(state.splats, task.train[5].camera, backend="numba").depth
        off[depth] = float((surface[surface > 0] - 2.0).abs().median())
    assert off["off"] > 0.08
    assert off["on"] < RENDERED_NOISE  # half of 5% of 2: from there on the loss is all but flat


def with_depth(task):
    config = replace(task.schedule.config, depth="on")
    views = [replace(view, depth=sensor(view.camera, np.full((30, 40), 2.0)))
             for view in task.train]
    return replace(task, train=views, schedule=Schedule(config))


def test_a_run_with_depth_that_is_interrupted_ends_with_the_same_bytes(tmp_path):
    config = replace(STRATEGIES["budget"], depth="on")
    runs = [first_state(config, backend="numba") for _ in range(2)]
    fit(runs[0], with_depth(tiny_task(config, backend="numba")), 40)
    fit(runs[1], with_depth(tiny_task(config, backend="numba")), 17)
    again = saved_and_loaded(runs[1], tmp_path, backend="numba", config=config)
    fit(again, with_depth(tiny_task(config, backend="numba")), 40)
    assert same(runs[0], again)
    plain = first_state(STRATEGIES["budget"], backend="numba")
    fit(plain, tiny_task(STRATEGIES["budget"], backend="numba"), 40)
    assert not same(runs[0], plain)


def test_a_run_that_is_to_do_without_depth_keeps_its_bytes():
    config = STRATEGIES["budget"]
    task = tiny_task(config, backend="numba")
    states = []
    for each in (task, replace(with_depth(task), schedule=Schedule(replace(config, depth="off")))):
        states.append(first_state(config, backend="numba"))
        fit(states[-1], each, 20)
    assert same(*states)


@pytest.mark.integration
def test_depth_that_fits_is_on_and_depth_that_spoils_the_images_is_off(monkeypatch):
    # At its own weight, depth that is wrong by a third costs this wall less than another seed.
    monkeypatch.setattr("recon_cli.train.parts.depth._WEIGHT", 0.05)
    scene = wall_scene()
    assert examine(scene).config.depth == "off"
    assert not [one for one in examine(scene).decisions if one.name == "depth"]
    decided = {}
    for z in (2.0, 1.4):
        views = [replace(view, depth=sensor(view.camera, np.full(view.image.shape[:2], z)))
                 for view in scene.task.train]
        needs = examine(replace(scene, task=replace(scene.task, train=views)))
        decided[z] = next(one for one in needs.decisions if one.name == "depth")
        assert needs.config.depth == ("on" if decided[z].on else "off")
    assert decided[2.0].on, decided[2.0].reason
    assert not decided[1.4].on, decided[1.4].reason


def test_depth_that_does_not_fit_the_model_is_off_and_says_why():
    scene = wall_scene(config=replace(WALL_CONFIG, background="off", exposure="off"))
    needs = examine(replace(scene, task=replace(
        scene.task, depth_refused="it differs from the points of the model by 31%")))
    assert needs.config.depth == "off"
    assert [one.reason for one in needs.decisions if one.name == "depth"] == [
        "it differs from the points of the model by 31%"]


def depth_weight(schedule, step):
    return step_options(schedule, step)["depth_weight"]


def test_the_weight_falls_over_the_run_and_leaves_every_other_step_to_the_images():
    schedule = Schedule(RunConfig(iterations=1000, depth="on"))
    weights = [depth_weight(schedule, step) for step in range(1, 1001)]
    assert not any(weights[::2])
    assert weights[1] > 10 * weights[-1] > 0
    assert sorted(weights[1::2], reverse=True) == weights[1::2]
    assert not any(depth_weight(Schedule(RunConfig(iterations=1000, depth=word)), 2)
                   for word in ("auto", "off"))
    later = make_schedule(RunConfig(iterations=1200, depth="on"), 1000)
    assert depth_weight(later, 1002) == pytest.approx(weights[-1])
