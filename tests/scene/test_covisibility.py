import numpy as np
import pytest
from facts import raises

from recon_cli.scene.camera import Camera
from recon_cli.scene.cells import Cell
from recon_cli.scene.covisibility import (
    Observations,
    context_points,
    label_points,
    observe_points,
    split_views,
    views_of_block,
)


def rooms(sizes, *, links=0, each=40, seed=0):
    """Returns rooms of views that see their room's points, `links` points seen from two rooms."""
    draws = np.random.default_rng(seed)
    room = np.repeat(np.arange(len(sizes)), sizes)
    points = draws.uniform(0, 1, (200 * len(sizes), 3))
    owner = np.repeat(np.arange(len(sizes)), 200)
    points[:, 0] += 3 * owner
    pairs = [(view, point) for view in range(len(room))
             for point in draws.choice(np.flatnonzero(owner == room[view]), each, replace=False)]
    for index in range(links):  # through a door
        first, second = np.flatnonzero(room == 0)[-1], np.flatnonzero(room == 1)[0]
        pairs += [(first, 200 + index), (second, index)]
    view, point = np.array(pairs).T
    return Observations(view, point, len(room), len(points)), room, points, owner


@pytest.mark.parametrize("links", [0, 12])
@pytest.mark.parametrize("sizes", [(30, 50), (25, 60, 40)])
def test_a_scene_is_cut_at_its_doors(sizes, links):
    observations, room, _, _ = rooms(sizes, links=links)
    assert (split_views(observations, len(sizes)) == room).all()


def test_a_long_corridor_is_cut_into_even_parts():
    view = np.repeat(np.arange(100), 20)
    point = (view.reshape(100, 20) * 5 + np.arange(20)).ravel()  # each view sees a stretch
    labels = split_views(Observations(view, point, 100, int(point.max()) + 1), 4)
    assert sorted(np.unique(labels)) == [0, 1, 2, 3]
    assert (np.diff(labels) >= 0).all()  # stretches, in the order of the way
    assert np.bincount(labels).min() >= 10


def test_more_blocks_than_pairs_of_views_are_refused():
    observations = rooms((2, 2))[0]
    with raises(ValueError, 3, 4):
        split_views(observations, 3)


def test_a_point_belongs_to_the_room_that_sees_it_most():
    observations, room, points, owner = rooms((30, 50), links=12)
    assert (label_points(observations, room, points) == owner).all()


def test_a_block_has_its_own_views_and_those_that_look_into_its_cell():
    observations, room, _, owner = rooms((30, 50), links=12)
    chosen = views_of_block(observations, owner, room, 0)
    assert chosen[:30].all()
    assert chosen[30]  # sees 12 of its 52 points through the door
    assert not chosen[31:].any()


def test_every_position_lies_in_exactly_one_cell():
    observations, room, points, _ = rooms((30, 50, 20))
    labels = label_points(observations, room, points)
    cells = [Cell(points, labels == index) for index in range(3)]
    positions = np.random.default_rng(1).uniform(-5, 12, (500, 3))
    assert (np.sum([cell.owns(positions) for cell in cells], axis=0) == 1).all()
    assert cells[1].owns(np.array([[3.5, 0.5, 0.5], [0.5, 0.5, 0.5]])).tolist() == [True, False]
    assert len(cells[0].owns(np.zeros((0, 3)))) == 0


def test_a_block_begins_with_all_of_its_points_and_a_quarter_of_the_others():
    owned = np.arange(4000) < 1000
    chosen = context_points(owned, seed=3)
    assert chosen[:1000].all()
    assert 650 < chosen[1000:].sum() < 850
    assert (chosen == context_points(owned, seed=3)).all()


def test_a_camera_does_not_see_the_next_room_through_a_wall():
    camera = Camera(64, 48, 50, 50, 32, 24, np.eye(4))
    x, y = np.meshgrid(np.linspace(-3, 3, 200), np.linspace(-3, 3, 200))
    near = np.stack([x, y, np.full_like(x, 5.0)], axis=-1).reshape(-1, 3)
    seen = observe_points(np.concatenate([near, near + np.array([0, 0, 0.15])]), [camera]).point
    assert len(seen) > 0
    assert (seen < len(near)).all()


def test_a_camera_sees_no_point_behind_another():
    camera = Camera(64, 48, 50, 50, 32, 24, np.eye(4))
    x, y = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60))
    wall = np.stack([x, y, np.full_like(x, 2.0)], axis=-1).reshape(-1, 3)
    points = np.concatenate([wall, [[0, 0, 4.0], [0, 0, -2.0], [50, 0, 2.0]]])
    seen = set(observe_points(points, [camera]).point.tolist())
    assert not seen & {3600, 3601, 3602}  # hidden, behind the camera, outside
    inside = np.abs(wall[:, 1]) < 0.95  # of the height of the picture
    assert seen == set(np.flatnonzero(inside).tolist())
