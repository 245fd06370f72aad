"""Regions that contradict other views, in views of a plane whose depth is known in every pixel."""

from dataclasses import replace

import numpy as np
import pytest

from recon_cli.scene.camera import Camera
from recon_cli.train.parts import moving_regions as moving
from recon_cli.train.parts.moving_regions import ComparedView, find_moving

H, W = 84, 150
NOISE = np.random.default_rng(0).normal(0, 0.004, (12, H, W, 3)).astype(np.float32)


def camera(shift):
    viewmat = np.eye(4)
    viewmat[0, 3] = -shift  # the cameras stand beside each other and look at the plane z = 3
    return Camera(W, H, 120.0, 120.0, W / 2, H / 2, viewmat)


def views():
    return [ComparedView(camera(0.05 * row), noise.copy(), np.full((H, W), 3.0, np.float32),
                         np.ones((H, W), bool)) for row, noise in enumerate(NOISE)]


def paint(view, lines, columns, error):
    view.error[lines, columns] += np.float32(error)


def area(regions):
    return [round(float(region.mean()), 3) for region in regions]


def test_nothing_is_found_where_nothing_moves():
    assert not any(area(find_moving(views())))


def test_a_person_in_few_views_is_found_with_little_around():
    some = views()
    for row in (4, 5, 6):
        paint(some[row], slice(20, 70), slice(30 + 20 * row - 80, 50 + 20 * row - 80), 0.4)
    found = find_moving(some)
    for row, region in enumerate(found):
        painted = np.zeros((H, W), bool)
        if row in (4, 5, 6):
            painted[20:70, 20 * row - 50:20 * row - 30] = True
            assert region[painted].all()
            assert (region & ~painted).mean() < 0.03  # its margin
        else:
            assert not region.any()


def test_an_error_that_all_views_share_is_one_of_the_model():
    some = views()
    for row, view in enumerate(some):  # one place of the plane
        column = round(75 - 120 * 0.05 * row / 3)
        paint(view, slice(20, 60), slice(column - 10, column + 10), 0.4)
    assert not any(area(find_moving(some)))


def test_an_error_of_most_views_is_dropped_though_each_contradicts_some():
    some, signs = views(), [1, -1] * 6
    for row, (view, sign) in enumerate(zip(some, signs, strict=True)):
        column = round(75 - 120 * 0.05 * row / 3)
        paint(view, slice(20, 60), slice(column - 10, column + 10), 0.4 * sign)
    assert not any(area(find_moving(some)))


@pytest.mark.parametrize(("lines", "columns", "error"), [
    (slice(20, 23), slice(20, 24), 0.5),  # small
    (slice(40, 41), slice(0, 140), 0.5),  # thin
    (slice(20, 60), slice(40, 70), 0.05),  # faint
])
def test_small_thin_and_faint_errors_are_not_regions(lines, columns, error):
    some = views()
    paint(some[5], lines, columns, error)
    assert not any(area(find_moving(some)))


def test_a_shadow_that_touches_a_person_belongs_to_the_region():
    some = views()
    paint(some[5], slice(20, 60), slice(60, 80), 0.4)
    paint(some[5], slice(60, 70), slice(55, 95), -0.09)
    assert find_moving(some)[5][62:68, 60:90].all()


def test_a_faint_part_far_from_the_strong_one_is_left():
    some = views()
    paint(some[5], slice(20, 60), slice(20, 40), 0.4)
    paint(some[5], slice(30, 34), slice(40, 130), -0.09)
    found = find_moving(some)[5]
    assert found[31:33, 40:54].all()  # a shadow of .12 of the longer side
    assert not found[:, 64:].any()


def test_a_view_that_fits_its_render_is_not_compared():
    some = views()
    assert not any(moving.find_candidates(view, 0.004).any() for view in some)
    paint(some[5], slice(20, 60), slice(60, 80), 0.4)
    candidates = moving.find_candidates(some[5], 0.004)
    assert candidates[20:60, 60:80].all()
    assert candidates.mean() < 0.1


@pytest.mark.parametrize(("agreed", "found"), [(12, False), (5, True)])
def test_where_others_disagree_a_region_is_only_found_once_it_is_likely(agreed, found):
    amount, spread = np.zeros((H, W), np.float32), np.zeros((H, W), np.float32)
    amount[20:60, 60:80], spread[20:60, 60:80] = 0.3, 0.03
    contradiction = moving.Contradiction(amount, spread, np.full((H, W), 8))
    assert moving.find_regions(contradiction, 0.01, agreed).any() == found


def test_what_too_few_others_see_is_not_judged():
    some = views()[:3]
    paint(some[1], slice(20, 60), slice(60, 80), 0.4)
    assert not any(area(find_moving(some)))


def test_surfaces_hidden_from_others_are_not_judged():
    some = views()
    near = np.full((H, W), 1.0, np.float32)  # others look at something in front
    some = [view if row == 5 else replace(view, depth=near) for row, view in enumerate(some)]
    paint(some[5], slice(20, 60), slice(60, 80), 0.4)
    assert not any(area(find_moving(some)))


def test_a_capture_whose_model_is_poor_is_not_judged():
    some = [replace(view, error=10 * view.error) for view in views()]
    paint(some[5], slice(20, 60), slice(60, 80), 0.6)
    assert moving.noise_level(some) > moving._TOO_NOISY
    assert not any(area(find_moving(some)))


def test_held_out_views_are_judged_by_the_others():
    some = views()
    paint(some[5], slice(20, 60), slice(60, 80), 0.4)
    found, = find_moving([some[5]], [*some[:5], *some[6:]])
    assert found[25:55, 62:78].all()


def test_the_median_gain_of_a_view_ignores_a_third_of_other_content():
    rgb = np.random.default_rng(1).uniform(0.2, 0.6, (30, 30, 3)).astype(np.float32)
    photo = rgb * np.float32([1.1, 0.9, 1.2])
    photo[:9] = 0.9
    gain = moving._median_gain(rgb, photo, np.ones((30, 30), bool))
    assert gain == pytest.approx([1.1, 0.9, 1.2], rel=0.02)
