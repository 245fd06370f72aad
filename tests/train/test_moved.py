"""A thing before a plane that half of the views show: where it is, and which views lose it."""

from dataclasses import replace

import numpy as np
import pytest
from wall_scene import scene

from recon_cli.scene.camera import Camera
from recon_cli.train.feature_trials import examine
from recon_cli.train.moved import Parts, Space, hide_rarer, is_walk, was_moved
from recon_cli.train.moving import ComparedView
from recon_cli.train.moving_search import enlarge

H, W, VIEWS = 84, 150, 24
NOISE = np.random.default_rng(0).normal(0, 0.004, (VIEWS, H, W, 3)).astype(np.float32)
FIRST = range(VIEWS // 2)
SECOND = range(VIEWS // 2, VIEWS)


def views():
    made = []
    for row, noise in enumerate(NOISE):
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.05 * row  # beside each other, before the plane z = 3
        made.append(ComparedView(
            Camera(W, H, 120.0, 120.0, W / 2, H / 2, viewmat), noise.copy(),
            np.full((H, W), 3.0, np.float32), np.ones((H, W), bool)))
    return made


def box(view, left=-0.45, depth=2.0):
    """Returns which pixels show a board half a metre wide at a depth."""
    x0, x1 = (view.camera.fx * (x + view.camera.viewmat[0, 3]) / depth + W / 2
              for x in (left, left + 0.5))
    result = np.zeros((H, W), bool)
    result[20:60, max(0, round(x0)):max(0, round(x1))] = True
    return result


def stand(some, rows, **place):
    for row in rows:
        some[row].error[box(some[row], **place)] += np.float32(0.3)
    return some


@pytest.mark.parametrize("rows", [FIRST, SECOND])
def test_what_one_half_shows_was_moved(rows):
    assert was_moved(stand(views(), rows))


def test_nothing_was_moved_where_views_agree():
    assert not was_moved(views())


def test_a_model_without_surface_was_not_moved():
    some = stand(views(), FIRST)
    assert not was_moved([replace(view, depth=np.zeros((H, W), np.float32)) for view in some])


def test_a_long_and_narrow_space_has_no_more_cells_than_others():
    some = [replace(view, depth=np.full((H, W), 0.05, np.float32)) for view in views()]
    for row, view in enumerate(some):
        view.camera.viewmat[0, 3] = -50.0 * row
    assert len(Space.of_views(some).cells) <= 500_000


def test_an_error_that_all_views_have_on_a_surface_was_not_moved():
    assert not was_moved(stand(views(), range(VIEWS), depth=3.0))


def test_what_is_on_the_surface_of_each_view_but_in_no_place_was_not_moved():
    some = views()
    for row in FIRST:  # it runs across the picture, as no place in space does
        left = 130 - 11 * row
        some[row].error[20:60, max(0, left - 14):left] += np.float32(0.3)
    assert not was_moved(some)


def test_a_poor_model_and_unordered_photos_are_not_judged():
    some = stand(views(), FIRST)
    assert not was_moved([replace(view, error=10 * view.error) for view in some])
    mixed = np.random.default_rng(1).permutation(VIEWS)
    cameras = [view.camera for view in some]
    assert is_walk(cameras)
    assert not is_walk([cameras[row] for row in mixed])
    assert not was_moved([some[row] for row in mixed])


@pytest.mark.parametrize("rows", [FIRST, SECOND])
def test_the_state_stays_that_more_views_saw(rows):
    some = stand(views(), rows)
    hidden = hide_rarer(some)
    # the first half sees the place in all of its views, the second in few
    assert not any(hidden[row].any() for row in FIRST)
    inside = [box(view) for view in some]
    seeing = [row for row in SECOND if inside[row].sum() > 600]
    assert len(seeing) >= 3
    for row in seeing:
        assert hidden[row][inside[row]].mean() > 0.75
        assert hidden[row].mean() < 0.3
    assert not any(hidden[row].any() for row in SECOND if not box(some[row]).any())


def test_without_a_thing_nothing_is_hidden():
    assert not any(region.any() for region in hide_rarer(views()))
    late = Parts.halves(views()).late
    assert late.sum() == VIEWS // 2
    assert not late[:VIEWS // 2].any()


def with_board(made):
    """Returns a scene whose first half has a red board before the wall."""
    shots, boards = [], []
    for row, view in enumerate(made.task.train):
        camera = view.camera
        u0, u1 = (camera.fx * (x + camera.viewmat[0, 3]) / 1.5 + camera.cx for x in (-0.7, -0.3))
        board = np.zeros((96, 128), bool)
        board[30:72, max(0, round(u0)):max(0, round(u1))] = True
        image = view.image.copy()
        if row < len(made.task.train) // 2:
            image[board] = 220, 20, 20
        shots.append(replace(view, stored=image))
        boards.append(board)
    return replace(made, task=replace(made.task, train=shots)), boards


@pytest.mark.integration
def test_a_board_that_was_taken_away_half_way_is_masked_in_the_half_that_saw_it_less():
    config = replace(scene().task.schedule.config, far="off", stereo="off", exposure="off",
                     iterations=1000, moving="auto")
    made, boards = with_board(scene(config=config))
    names = tuple(f"{row:04d}" for row in range(len(boards)))
    needs = examine(replace(made, names=names))
    assert needs.moving is not None
    half = len(boards) // 2
    covered = [(enlarge(region, 128, 96) & board).sum() / board.sum()
               for region, board in zip(needs.moving, boards, strict=True)]
    # the board itself, which has no sparse points, is new to a short model in some views
    assert np.mean(covered[half:]) > 0.8 > 0.4 > np.mean(covered[:half])
