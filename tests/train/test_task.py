"""Reduced views are the same scene at fewer pixels; how far a task moves its Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import camera_at, random_splats
from tiny_task import CONFIG, EXTENT, same, tiny_task

from recon_cli.io.images import reduce_view
from recon_cli.render import render
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.initialize import begin_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.task import Pyramid

# A picture that is rendered small and one that is rendered large and averaged differ by what a
# pixel's blur adds. Measured .03 on soft Gaussians; a camera off by half a pixel gives .09.
PICTURE = 0.05


def view(width=64, height=48, mask=None):
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    return TrainView(camera_at(width, height), image, mask)


def test_a_pixel_is_the_mean_of_those_that_it_covers():
    small = reduce_view(view(), 2)
    blocks = view().image.reshape(24, 2, 32, 2, 3).mean((1, 3))
    assert np.abs(small.image - blocks).max() <= 0.5
    assert (small.camera.width, small.camera.height) == (32, 24)


def test_the_camera_of_a_reduced_view_shows_the_same_picture():
    splats = random_splats(30, dtype=torch.float32)
    splats.log_scales = splats.log_scales.clamp_min(-1.0)
    camera = camera_at(64, 48, focal=60.0)
    with torch.no_grad():
        large = render(splats, camera, torch.zeros(3), 0).rgb
        truth = TrainView(camera, (large.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
        small = reduce_view(truth, 2)
        rgb = render(splats, small.camera, torch.zeros(3), 0).rgb.clamp(0, 1).numpy()
    assert np.abs(rgb - small.image / 255).mean() < PICTURE


def test_sizes_that_do_not_divide_keep_the_field_of_view():
    odd = reduce_view(view(101, 75), 4)
    assert (odd.camera.width, odd.camera.height) == (25, 19)
    full = view(101, 75).camera
    assert odd.camera.fx / 25 == pytest.approx(full.fx / 101)
    assert odd.camera.fy / 19 == pytest.approx(full.fy / 75)


def test_a_reduced_pixel_counts_only_where_all_that_it_covers_counts():
    mask = np.ones((96, 128), bool)
    mask[10, 10] = False
    small = reduce_view(view(128, 96, mask), 4)
    assert small.mask is not None
    assert not small.mask[2, 2]
    assert small.mask.sum() == small.mask.size - 1


def test_an_image_that_would_be_too_small_stays_as_it_is():
    tiny = view(40, 30)
    assert reduce_view(tiny, 4) is tiny


def test_a_pyramid_makes_each_size_once():
    pyramid = Pyramid([view()])
    assert pyramid.view(0, 2) is pyramid.view(0, 2)
    assert pyramid.view(0, 1).image.shape == (48, 64, 3)


def moved(task):
    state = begin_state(random_splats(40, seed=1, dtype=torch.float32), task)
    fit(state, task, 3)
    return state


def test_a_longer_walk_past_the_same_things_moves_no_gaussian_further():
    task = replace(tiny_task(replace(CONFIG, densify="budget")), nearness=0.5)
    assert same(moved(task), moved(replace(task, extent=10 * EXTENT)))
    assert not same(moved(task), moved(replace(task, nearness=1.0)))


def test_without_points_the_extent_counts():
    task = tiny_task(replace(CONFIG, densify="budget"))
    assert not same(moved(task), moved(replace(task, extent=10 * EXTENT)))


def test_the_reference_moves_means_by_the_extent():
    task = replace(tiny_task(replace(CONFIG, densify="reference")), nearness=0.5)
    assert not same(moved(task), moved(replace(task, extent=10 * EXTENT)))
    assert same(moved(task), moved(replace(task, nearness=1.0)))
