"""Depth by dense stereo beside that of the Gaussians, on a wall that is known exactly."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import pytest
from walls import AROUND, HEIGHT, WIDTH, errors, grain, views_of, wall

from recon_cli.progress import NullProgress
from recon_cli.room import stereo_depths as stereo
from recon_cli.room.depth_maps import weigh
from recon_cli.room.stereo_depths import with_stereo
from recon_cli.room.volume import pixel_rays
from recon_cli.scene.gravity import Gravity

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)


def maps_of(cameras, paint):
    """Maps of the wall, whose depth the Gaussians know."""
    depths = [wall(view, 0.0)[0] for view in cameras]
    return weigh(views_of(cameras, paint), cameras, depths, [np.ones_like(d) for d in depths])


@pytest.mark.integration
def test_what_was_cut_off_stays_off():
    maps = maps_of(AROUND, grain)
    box = np.array([-1.0, -0.3, -9.0]), np.array([4.0, 9.0, 9.0])
    found = with_stereo(maps, box, NullProgress())
    assert len(found.depths) == 2 * len(AROUND)
    for view, depth in zip(found.cameras[len(AROUND):], found.depths[len(AROUND):], strict=True):
        places = view.center + pixel_rays(view) @ view.viewmat[:3, :3] * depth[..., None]
        assert (depth > 0).any()
        assert (places[depth > 0, 1] >= -0.3).all()


class Counted(NullProgress):
    """Notes how much a bar was to show, and how much it showed."""

    def __init__(self):
        self.total = self.done = 0

    @contextmanager
    def bar(self, _label, total, **_):
        self.total = total
        yield self

    def advance(self, steps=1):
        self.done += steps


@pytest.mark.parametrize(("up", "searches"), [(None, 2), (np.array([0.0, 0.0, 1.0]), 3)])
def test_level_planes_are_searched_where_up_is_known(monkeypatch, up, searches):
    monkeypatch.setattr(stereo, "find_gravity", lambda *_: Gravity(up, None, None))
    progress = Counted()
    found = with_stereo(maps_of(AROUND[:4], grain), EVERYWHERE, progress)
    assert progress.total == progress.done == searches * 4
    error, share = errors(AROUND[:4], found.depths[4:])
    assert share > 0.6
    assert np.median(error) < 0.0025


@pytest.mark.integration
def test_large_views_are_searched_at_600_pixels_and_compared_at_their_own(monkeypatch):
    monkeypatch.setattr(stereo, "_SIDE", 80)
    maps = maps_of(AROUND, grain)
    maps.depths[0][:] *= 1.1  # of the Gaussians: wrong in one view
    found = with_stereo(maps, EVERYWHERE, NullProgress())
    assert found.depths[0].shape == (HEIGHT, WIDTH)
    assert found.depths[len(AROUND)].shape == (HEIGHT // 2, WIDTH // 2)
    assert found.views[len(AROUND)].image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert (found.gains[0] > 0).mean() < 0.3 < (found.gains[1] > 0).mean()


@pytest.mark.integration
def test_of_many_views_some_get_a_map(monkeypatch):
    monkeypatch.setattr(stereo, "_MOST_VIEWS", 5)
    maps = maps_of(AROUND, grain)
    found = with_stereo(maps, EVERYWHERE, NullProgress())
    assert len(found.depths) == len(AROUND) + 5
    assert found.cameras[-1].center == pytest.approx(AROUND[-1].center)
    error, share = errors(found.cameras[len(AROUND):], found.depths[len(AROUND):])
    assert share > 0.7
    assert np.median(error) < 0.0025


def test_a_range_comes_from_all_views_where_one_shows_nothing():
    maps = maps_of(AROUND[:3], grain)
    maps.depths[1] = np.zeros_like(maps.depths[1])
    photo = stereo._photos(maps)[1]
    assert 2.5 < photo.nearest < 3 < photo.farthest < 3.7
