"""Floaters are told by what the views say: who sees each one, and what its absence changes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import random_splats

from recon_cli.export.cleanup import count_sightings, find_floaters, measure_harm
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0, Splats, joined
from recon_cli.scene.train_view import TrainView


def camera(x, *, side=32):
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return Camera(side, side, 30, 30, side / 2, side / 2, viewmat)


def round_ones(places, *, scale, opacity=0.9, color=(0.9, 0.1, 0.1), dtype=torch.float32):
    n = len(places)
    return Splats(
        torch.tensor(places, dtype=dtype), torch.tensor([1.0, 0, 0, 0], dtype=dtype).repeat(n, 1),
        torch.full((n, 3), float(np.log(scale)), dtype=dtype),
        torch.logit(torch.full((n,), opacity, dtype=dtype)),
        ((torch.tensor(color, dtype=dtype) - 0.5) / SH_C0).repeat(n, 1),
        torch.zeros(0, 0, 3, dtype=dtype))


def wall(depth=4.0, *, half=6.0, spacing=0.25):
    """An opaque wall of many colours, which fills every view of `camera`."""
    steps = np.arange(-half, half, spacing)
    made = round_ones([(x, y, depth) for x in steps for y in steps], scale=0.15, opacity=0.97)
    made.sh_dc = torch.sin(5 * made.means)
    return made


def shown(splats, at, **more):
    with torch.no_grad():
        rgb = render(splats, at, torch.zeros(3), splats.sh_degree, backend="numba").rgb
    return TrainView(at, (rgb.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8), **more)


def error(splats, views):
    """Squared error over all views, by rendering."""
    total = 0.0
    for view in views:
        with torch.no_grad():
            rgb = render(splats, view.camera, torch.zeros(3, dtype=splats.means.dtype), 0).rgb
        difference = (rgb - view.pixels(torch.device("cpu"))).square().sum(dim=-1)
        counting = view.counting(torch.device("cpu"))
        total += float((difference if counting is None else difference[counting]).sum())
    return total


@pytest.mark.parametrize("masked", [False, True])
def test_harm_is_what_the_error_falls_by_without_that_one(masked):
    splats = random_splats(8, seed=1).with_degree(0)
    splats.means[:, 2] = 3 + splats.means[:, 2].abs()
    splats.logit_opacities.clamp_(-1.0, 1.0)  # no alpha is clamped, no pixel is full
    rng = np.random.default_rng(0)
    views = [TrainView(camera(x), rng.integers(0, 256, (32, 32, 3)).astype(np.uint8),
                       rng.random((32, 32)) < 0.6 if masked else None) for x in (-0.2, 0.3)]
    found, total = measure_harm(splats, views, backend="torch")
    assert total == pytest.approx(error(splats, views), rel=1e-9)
    for row in range(len(splats)):
        without = splats.select(torch.arange(len(splats)) != row)
        assert float(found[row]) == pytest.approx(total - error(without, views), abs=1e-9 * total)


@pytest.fixture(scope="module")
def room():
    """A wall, and what six cameras in front of it see."""
    made = wall()
    return made, [shown(made, camera(x)) for x in np.linspace(-1, 1, 6)]


def found_in(splats, views):
    return find_floaters(splats, views, backend="numba")


def test_nothing_is_taken_from_what_views_show(room):
    made, views = room
    seen = count_sightings(made, views, backend="numba") > 0
    found = found_in(made, views)
    assert torch.equal(found.unseen, ~seen)
    assert not found.in_front.any()
    assert not found.harmful.any()


def test_planted_floaters_go_and_the_rest_stays(room):
    made, views = room
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.uniform(-0.8, 0.8, (12, 2)), rng.uniform(1.0, 3.0, 12)])
    planted = round_ones(places, scale=0.12, opacity=0.6)
    both, order = joined([made, planted])
    found = found_in(both, views)
    floats = order >= len(made)
    assert found.all[floats].all()
    assert torch.equal(found.all[~floats], found_in(made, views).all)


def test_two_floaters_one_behind_the_other_both_go(room):
    made, views = room
    planted = round_ones([(0.0, 0, 1.5), (0.0, 0, 2.2)], scale=0.15)
    both, order = joined([made, planted])
    assert found_in(both, views).harmful[order >= len(made)].all()


def test_what_hangs_before_the_only_view_that_sees_it_goes_although_that_view_shows_it():
    made, places = wall(), np.linspace(-1.5, 1.5, 7)
    for depth, goes in ((0.2, True), (3.6, False)):  # near the camera, near the wall
        thing = round_ones([(0.0, 0.0, depth)], scale=0.01 if goes else 0.05)
        both, order = joined([made, thing])
        views = [shown(both if x == 0 else made, camera(x)) for x in places]
        found = found_in(both, views)
        assert found.in_front[order >= len(made)].tolist() == [goes]
        assert not found.in_front[order < len(made)].any()


def test_what_three_views_agree_on_is_no_floater():
    made, thing = wall(), round_ones([(0.0, 0.0, 1.2)], scale=0.08)
    both, order = joined([made, thing])
    views = [shown(both, camera(x)) for x in (-0.1, 0.0, 0.1)]
    found = found_in(both, views)
    assert not found.all[order >= len(made)].any()


def test_nothing_is_behind_an_object_before_the_void():
    thing = round_ones([(0.0, 0.0, 1.2)], scale=0.08)
    views = [shown(thing, camera(0.0))]
    assert not found_in(thing, views).all.any()
