"""Captures that break assumptions: training ends, is finite, and is as good as it can be."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from wall_scene import CONFIG, EXTENT, scene

from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.initialize import first_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.parts.trials import examine

STEPS = 200
PLAIN = replace(
    CONFIG, iterations=STEPS, densify_every=20, background="off", exposure="off",
    early_stop=False)


def trained(candidate, config=PLAIN, **changes):
    """The state after a run on the views of a scene, some of its task's fields changed."""
    task = replace(candidate.task, schedule=Schedule(config), **changes)
    state = first_state(task, candidate.points, candidate.colors, most=1000)
    fit(state, task, config.iterations)
    assert all(torch.isfinite(value).all() for value in state.splats.parameters().values())
    return state


def psnr(state, views, mask=None):
    errors = []
    for view in views:
        with torch.no_grad():
            rgb = render(
                state.splats, view.camera, state.splats.background, 0, backend="numba").rgb
        error = (rgb.clamp(0, 1).numpy() - view.image / 255) ** 2
        errors.append(error[mask].mean() if mask is not None else error.mean())
    return -10 * np.log10(max(np.mean(errors), 1e-10))


def scaled(candidate, factor):
    """The same scene in other units."""
    def larger(view):
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] *= factor
        return TrainView(replace(view.camera, viewmat=viewmat), view.image)

    task = replace(candidate.task, train=[larger(view) for view in candidate.task.train],
                   extent=factor * candidate.task.extent,
                   nearness=factor * candidate.task.nearness)
    return replace(candidate, task=task, points=factor * candidate.points)


@pytest.fixture(scope="module")
def plain():
    candidate = scene(views=12)
    candidate = replace(candidate, task=replace(candidate.task, nearness=EXTENT))
    return candidate, psnr(trained(candidate), candidate.task.train)


@pytest.mark.integration
def test_points_all_on_one_plane_are_trained(plain):
    _, reached = plain
    assert reached > 25


@pytest.mark.integration
@pytest.mark.parametrize("factor", [1000.0, 0.1])
def test_a_scene_in_other_units_is_trained_as_well(plain, factor):
    candidate, reached = plain
    other = scaled(candidate, factor)
    assert psnr(trained(other), other.task.train) == pytest.approx(reached, abs=0.5)


@pytest.mark.integration
def test_views_all_at_one_place_are_trained():
    candidate = scene(views=12)
    one = candidate.task.train[0]
    assert psnr(trained(candidate, train=[one] * 6), [one]) > 25


def test_cameras_in_one_place_have_an_extent():
    camera = Camera(40, 30, 30.0, 30.0, 20.0, 15.0, np.eye(4))
    views = tuple(View(f"{i}.png", camera, None, None) for i in range(3))
    points = np.array([[0.0, 0, 2], [0, 0, 4], [0, 0, 3]])
    found = Scene(views, (), (), (), points, np.zeros((3, 3), np.uint8))
    assert found.extent == pytest.approx(0.05 * 3)
    assert found.nearness == pytest.approx(3)


@pytest.mark.integration
def test_constant_images_become_their_colour():
    candidate = scene(views=8)
    views = [TrainView(view.camera, np.full_like(view.image, 90)) for view in candidate.task.train]
    state = trained(candidate, train=views)
    assert psnr(state, views) > 20


@pytest.mark.integration
def test_black_images_do_no_harm():
    candidate = scene(views=8)
    views = [TrainView(view.camera, np.zeros_like(view.image)) for view in candidate.task.train]
    assert psnr(trained(candidate, train=views), views) > 20


@pytest.mark.integration
def test_a_gaussian_that_no_view_sees_stays_where_it_is():
    candidate = scene(views=8)
    hidden = np.array([[0.0, 0.0, -5.0]])  # behind all cameras
    points = np.concatenate([candidate.points, hidden])
    colors = np.concatenate([candidate.colors, np.zeros((1, 3), np.uint8)])
    state = trained(replace(candidate, points=points, colors=colors))
    away = (state.splats.means.detach() - torch.tensor([0.0, 0.0, -5.0])).norm(dim=1)
    assert away.min() < 1e-3


@pytest.mark.integration
def test_a_thing_that_moves_leaves_the_rest_as_it_is():
    candidate = scene(views=12)
    views, still = [], np.ones((96, 128), bool)
    still[30:60] = False
    for i, view in enumerate(candidate.task.train):
        image = view.image.copy()
        image[35:55, 8 * i:8 * i + 20] = (250, 20, 20)
        views.append(TrainView(view.camera, image))
    reached = psnr(trained(candidate, train=views), views, still)
    assert reached > psnr(trained(candidate), candidate.task.train, still) - 2.5


@pytest.mark.integration
def test_jumps_of_the_exposure_are_taken_by_gains():
    candidate = scene(drift=0.15)
    truth = scene().task.train
    with_gains = trained(candidate, replace(PLAIN, exposure="on"))
    without = trained(candidate)
    # the mean exposure of the capture is not quite that of the truth; the plain one is not either
    assert psnr(with_gains, truth) > psnr(without, truth) + 0.3
    gains, = with_gains.photometry._parts
    assert np.abs(gains.log_gains.mean(axis=0)).max() < 1e-9


@pytest.mark.integration
def test_nothing_of_the_scene_in_any_view_leaves_the_first_gaussians():
    candidate = scene(views=8)
    away = np.diag([-1.0, 1.0, -1.0, 1.0])  # all cameras turned round
    views = [TrainView(replace(view.camera, viewmat=away @ view.camera.viewmat), view.image)
             for view in candidate.task.train]
    state = trained(candidate, replace(PLAIN, densify="reference"), train=views)
    assert len(state.splats) == 1000


@pytest.mark.integration
def test_a_scene_of_few_views_is_examined_and_trained():
    needs = examine(scene(window=True, views=4))
    assert needs.config.background == "off"
    candidate = scene(views=4)
    assert psnr(trained(candidate), candidate.task.train) > 20
