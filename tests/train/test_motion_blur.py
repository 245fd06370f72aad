"""Blurred renders of blurred views: their light, their gradients, and a sharper scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from blurred_wall import filmed
from scenes import camera_at, random_splats
from tiny_task import CONFIG, first_state, same, saved_and_loaded, tiny_task
from wall_scene import scene

from recon_cli.errors import ConfigError
from recon_cli.evaluation.reference_views import mean_psnr
from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.render.response import Response
from recon_cli.scene.motion import Motion
from recon_cli.scene.train_view import TrainView
from recon_cli.train import initialize
from recon_cli.train.feature_trials import examine
from recon_cli.train.fit import fit
from recon_cli.train.gradient import gradient_step, photometric_loss
from recon_cli.train.motion_blur import (
    BlurredSteps,
    cameras_along,
    mean_light,
    turn_chances,
)
from recon_cli.train.schedule import Schedule, make_schedule
from recon_cli.train.shutter import ViewMotions
from recon_cli.train.state import new_state

TOLERANCE = 2e-5  # of float32 gradients against float64, relative in the 2-norm
LIFT = 1 / 255
MOTION = Motion(np.array([0.0, 0.4, 0.1]), np.array([0.5, 0.0, 0.2]))
POINTS = random_splats(40, seed=0).means.numpy().astype(np.float64)
BLURRED = replace(CONFIG, blur="on", shutter=0.5)
every_cpu_backend = pytest.mark.parametrize("backend", ["torch", "numba"])


def blurred_task(config=BLURRED, backend="torch"):
    task = tiny_task(config, backend=backend)
    motions = ViewMotions((MOTION,) * len(task.train), (MOTION,), POINTS)
    return replace(task, motions=motions)


def test_light_is_added_and_not_its_root():
    black, white = torch.zeros(2, 2, 3), torch.ones(2, 2, 3)
    assert mean_light([black, white]).numpy() == pytest.approx(0.5 ** (1 / 2.2), abs=2e-3)
    grey = torch.full((2, 2, 3), 0.3)
    assert mean_light([grey, grey]).numpy() == pytest.approx(0.3, abs=1e-6)


def test_a_way_is_seen_from_both_sides_of_its_middle():
    camera = camera_at(40, 30)
    cameras = cameras_along(camera, MOTION, 0.1, 50.0)
    assert len(cameras) == 3
    assert np.allclose(cameras[0].viewmat, camera.viewmat)
    assert np.allclose(np.mean([each.center for each in cameras], axis=0), camera.center)
    assert np.linalg.norm(cameras[1].center - cameras[2].center) == pytest.approx(
        0.1 * 2 / 3 * np.linalg.norm(MOTION.move))
    assert len(cameras_along(camera, MOTION, 0.1, 500.0)) == 5, "a longer way"
    assert cameras_along(camera, MOTION, 0.1, 5.0) == [camera], "half a pixel is not blurred"
    assert cameras_along(camera, None, 0.1, 500.0) == [camera]


@every_cpu_backend
@pytest.mark.parametrize("gain", [None, np.array([1.3, 1.0, 0.8], np.float32)])
def test_the_gradients_are_those_of_the_mean_of_the_light(backend, gain):
    camera = camera_at(40, 30)
    photo = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    splats = random_splats(60, seed=13, dtype=torch.float32)
    task = replace(blurred_task(replace(BLURRED, sh_degree=3), backend), train=[
        TrainView(camera, photo)] * 4)
    state = new_state(splats, task.schedule.config, 1.0, backend=backend)
    compute = BlurredSteps(task, gradient_step(backend)).choose(task.train[0], 0, 60)
    loss, statistics = compute(state.optimizer, task.train[0], StepOptions(3, 0.2),
                               None if gain is None else Response(gain))
    assert statistics is not None

    leaves = splats.map(lambda tensor: tensor.detach().double().requires_grad_())
    log_gain = torch.from_numpy(np.ones(3) if gain is None else gain).double().log()
    log_gain.requires_grad_()
    image = torch.stack([
        render(leaves, each, torch.zeros(3, dtype=torch.float64), 3,
               backend="torch").rgb + LIFT
        for each in compute.cameras]).pow(2.2).mean(0).pow(1 / 2.2) - LIFT
    image = image * log_gain.exp()
    expected = photometric_loss(image, torch.from_numpy(photo).double() / 255, 0.2)
    expected.backward()
    assert len(compute.cameras) == 5
    assert loss == pytest.approx(expected.item(), abs=1e-6)
    held = state.optimizer.gradients.parameters() if state.optimizer.fused else {
        name: leaf.grad for name, leaf in state.splats.parameters().items()}
    for name, value in held.items():
        theirs = getattr(leaves, name).grad
        assert (value.double() - theirs).norm() <= TOLERANCE * theirs.norm(), name
    if gain is not None:
        assert compute.response_gradient.log_gain == pytest.approx(log_gain.grad.numpy(), rel=1e-4)


def test_only_the_last_part_of_a_run_is_blurred_and_all_of_a_continued_one():
    plain = gradient_step("torch")
    task = blurred_task()
    steps = BlurredSteps(task, plain)
    assert steps.choose(task.train[0], 0, 36) is None
    assert steps.choose(task.train[0], 0, 37) is not None
    off = BlurredSteps(replace(task, schedule=Schedule(CONFIG)), plain)
    assert off.choose(task.train[0], 0, 60) is None
    continued = replace(task, schedule=make_schedule(BLURRED, 0))
    assert BlurredSteps(continued, plain).choose(task.train[0], 0, 1) is not None


def test_an_interrupted_run_ends_with_the_same_bytes(tmp_path):
    task = blurred_task(backend="numba")
    whole, part = (first_state(BLURRED, backend="numba") for _ in range(2))
    fit(whole, task, 60)
    fit(part, task, 45)
    part = saved_and_loaded(part, tmp_path, backend="numba", config=BLURRED)
    fit(part, task, 60)
    assert same(whole, part)
    plain = first_state(BLURRED, backend="numba")
    fit(plain, replace(task, schedule=Schedule(CONFIG)), 60)
    assert not same(whole, plain)


def test_sharp_views_have_more_turns_and_much_blurred_ones_none_where_others_see_the_same():
    task = tiny_task(BLURRED)
    slow, fast, wild = (
        Motion(np.zeros(3), np.array([speed, 0, 0])) for speed in (0.05, 0.3, 9.0))
    train = [task.train[0]] * 6
    task = replace(task, train=train, motions=ViewMotions(
        (slow, slow, slow, slow, fast, wild), (), POINTS))
    chances = turn_chances(task).numpy()
    assert (chances[:4] == 1).all()
    assert 0.2 < chances[4] < 1
    assert chances[5] == 0
    alone = replace(task.train[0].camera, viewmat=np.diag([-1.0, 1, -1, 1]))
    behind = np.concatenate([POINTS, POINTS * [1, 1, -1]])  # what it alone shows
    turned = replace(
        task, train=[*train[:5], replace(train[0], camera=alone)],
        motions=replace(task.motions, points=behind))
    assert 0 < turn_chances(turned).numpy()[5] < 1


def test_an_epoch_without_blur_has_every_view_once():
    task = blurred_task(CONFIG)
    steps = BlurredSteps(task, gradient_step("torch"))
    generator = torch.Generator().manual_seed(0)
    state = generator.get_state()
    order = torch.arange(4)
    assert torch.equal(steps.draw(order, generator, 60), order)
    assert torch.equal(generator.get_state(), state), "no number is drawn"


def test_blur_without_motion_or_time_is_refused():
    with pytest.raises(ConfigError, match="how the camera moved"):
        BlurredSteps(tiny_task(BLURRED), gradient_step("torch"))
    unknown = blurred_task(replace(BLURRED, shutter=None))
    with pytest.raises(ConfigError, match="for how long") as caught:
        BlurredSteps(unknown, gradient_step("torch"))
    assert "--shutter" in caught.value.hint


@pytest.mark.slow
def test_a_trial_finds_blur_and_the_run_leaves_it_out_of_the_scene():
    made = scene()
    # few Gaussians are as wide as the blur, and show no gain
    config = replace(made.task.schedule.config, far="off", exposure="off", stereo="off",
                     max_gaussians=8000)
    task, sharp = filmed(replace(made.task, schedule=Schedule(config)), 0.09)
    points = task.motions.points
    task_scene = replace(made, task=task, points=points,
                         colors=np.full((len(points), 3), 128, np.uint8))
    needs = examine(task_scene)
    assert needs.config.blur == "on", needs.decisions
    scores = {}
    for name, chosen in (("on", needs.config), ("off", replace(needs.config, blur="off"))):
        run = replace(task, schedule=Schedule(chosen))
        state = initialize.first_state(run, points, task_scene.colors, most=8000)
        fit(state, run, chosen.iterations)
        scores[name] = mean_psnr(state.splats, sharp, 0, "numba")
    assert scores["on"] > scores["off"] + 1.0, scores


@pytest.mark.integration
def test_sharp_views_pay_for_no_trial():
    task, _ = filmed(scene().task, 0.0)
    points = task.motions.points
    needs = examine(replace(
        scene(), task=task, points=points, colors=np.full((len(points), 3), 128, np.uint8)))
    decision = next(one for one in needs.decisions if one.name == "blur")
    assert not decision.on
    assert decision.seconds == 0
    assert needs.config.blur == "off"
    assert needs.config.shutter is None
