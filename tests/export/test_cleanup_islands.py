"""Islands: small, apart, and not seen through a window."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon_cli.export.cleanup import find_islands
from recon_cli.scene.splats import Splats, joined

pytestmark = pytest.mark.floors


def gaussians(places, *, scales=(0.06, 0.06, 0.06), opacity=0.9):
    n = len(places)
    return Splats(
        torch.tensor(np.asarray(places), dtype=torch.float32),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.log(torch.tensor(scales)).repeat(n, 1), torch.logit(torch.full((n,), opacity)),
        torch.zeros(n, 3), torch.zeros(0, 0, 3))


def box(*, half=2.0, spacing=0.1):
    """The six walls of a room."""
    steps = np.arange(-half, half + 1e-9, spacing)
    grid = np.array([(a, b) for a in steps for b in steps])
    walls = []
    for axis in range(3):
        for side in (-half, half):
            walls.append(np.insert(grid, axis, side, axis=1))
    return gaussians(np.concatenate(walls))


def ball(center, n=30, *, spread=0.05, **more):
    return gaussians(np.random.default_rng(0).normal(center, spread, (n, 3)), **more)


def found(scene, other, *, near=None, seen=None):
    """Which of `other` are islands; none of `scene` may be."""
    both, order = joined([scene, other])
    everywhere = torch.ones(len(both), dtype=torch.bool)
    goes = find_islands(both, everywhere if near is None else near[order],
                   None if seen is None else seen[order])
    assert not goes[order < len(scene)].any()
    return goes[order >= len(scene)]


@pytest.fixture(scope="module")
def room():
    return box()


def marked(room, other, value):
    """[N] bool, True in the room and `value` elsewhere."""
    return torch.cat([torch.ones(len(room), dtype=torch.bool),
                      torch.full((len(other),), value, dtype=torch.bool)])


def test_a_group_in_mid_air_goes_and_the_room_stays(room):
    assert found(room, ball((0.3, -0.2, 0.4))).all()


def test_what_touches_a_wall_stays(room):
    assert not found(room, ball((0.0, 0.0, 1.9))).any()


def test_what_is_close_to_a_wall_stays(room):
    single = gaussians([(0.0, 0.0, 1.92)], scales=(0.001, 0.001, 0.001))
    assert not found(room, single).any()


def test_a_large_group_is_a_thing_and_stays(room):
    assert not found(room, ball((0, 0, 0), n=len(room) // 100, spread=0.1)).any()


def test_far_content_is_left_alone(room):
    far = ball((80.0, 0, 0), n=20, scales=(3.0, 3.0, 3.0))
    assert not found(room, far, near=marked(room, far, False)).any()
    assert found(room, far).all()


def test_what_a_view_sees_outside_stays_and_what_none_sees_goes(room):
    outside = ball((5.0, 0, 0))
    assert not found(room, outside, seen=marked(room, outside, True)).any()
    assert found(room, outside, seen=marked(room, outside, False)).all()
    inside = ball((0.3, -0.2, 0.4))
    assert found(room, inside, seen=marked(room, inside, True)).all()


def test_gaussians_touch_along_their_axes_alone(room):
    """A row of needles that leads to the wall holds together; turned across, it does not."""
    places = [(x, 0.0, 0.0) for x in np.arange(0.0, 2.0, 0.3)]
    assert not found(room, gaussians(places, scales=(0.06, 0.004, 0.004))).any()
    assert found(room, gaussians(places, scales=(0.004, 0.004, 0.06)))[:5].all()


def test_what_is_too_faint_to_be_drawn_holds_nothing_together(room):
    bridge = gaussians([(x, 0.0, 0.0) for x in np.arange(0.3, 2.0, 0.1)], opacity=0.002)
    lamp = ball((0.0, 0.0, 0.0))
    both, order = joined([bridge, lamp])
    assert found(room, both).equal(order >= len(bridge))


def test_a_scene_of_a_few_has_no_islands():
    scene = ball((0, 0, 0), n=10)
    assert not find_islands(scene, torch.ones(10, dtype=torch.bool), None).any()
