"""Points on a painted wall whose place is known, and when there are none."""

from functools import cache

import numpy as np
import pytest
from walls import AROUND, camera, grain, shading, views_of

from recon_cli.scene.covisibility import observe_points
from recon_cli.train.fit.task import Evidence
from recon_cli.train.parts import stereo
from recon_cli.train.parts.stereo import SurfacePoints, find_surfaces

# along the edges of a wall whose middle has no texture
EDGE = np.array([[3.0, y, z] for y in np.linspace(-1.6, 1.6, 40) for z in (-1.1, 1.1)])


def tracks_of(points, cameras=AROUND):
    """Tracks of points in every view that has them in its image."""
    seen = observe_points(points, cameras).matrix.toarray() > 0
    return [np.flatnonzero(row) for row in seen]


def found(points=EDGE, paint=shading, cameras=AROUND, tracks=None):
    tracks = tracks or tracks_of(points, cameras)
    return find_surfaces(Evidence(views_of(cameras, paint), points, 1.0, lambda: tracks))


@cache
def found_on(paint):
    """What is found on the wall with points along its edges."""
    return found(paint=paint)


@pytest.mark.integration
@pytest.mark.parametrize("paint", [shading, grain])
def test_they_lie_on_the_wall_one_in_a_cell(paint):
    surfaces = found_on(paint)
    assert len(surfaces.points) > 150
    assert np.median(np.abs(surfaces.points[:, 0] - 3)) < 0.03
    assert np.mean(np.abs(surfaces.points[:, 0] - 3) < 0.1) > 0.95
    depths = [EDGE[seen] @ view.viewmat[2, :3] + view.viewmat[2, 3]
              for view, seen in zip(AROUND, tracks_of(EDGE), strict=True)]
    cells = np.floor(surfaces.points / (np.median(np.concatenate(depths)) / 25))
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_they_have_the_colour_of_the_wall():
    surfaces = found_on(shading)
    expected = shading(surfaces.points)
    assert np.median(np.abs(surfaces.colors[:, 0] - expected)) < 3


@pytest.mark.integration
def test_a_cell_with_a_sparse_point_gets_none():
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.03), np.arange(-1.6, 1.6, 0.03))
    everywhere = np.stack([np.full_like(y, 3.01), y, z], -1).reshape(-1, 3)
    assert len(found(everywhere, grain).points) < 0.2 * len(found_on(grain).points)


@pytest.mark.integration
def test_without_tracks_points_in_the_image_tell_the_depth():
    nothing = [np.empty(0, np.int64)] * len(AROUND)
    assert found(tracks=nothing).points.tolist() == found_on(shading).points.tolist()


@pytest.mark.integration
def test_a_view_that_sees_few_points_is_left_out():
    *others, last = tracks_of(EDGE)
    rest = found(cameras=AROUND[:-1])
    assert found(tracks=[*others, last[:3]]).points.tolist() == rest.points.tolist()


@pytest.mark.parametrize("points", [EDGE[:5], np.empty((0, 3))])
def test_too_few_points_tell_nothing(points):
    surfaces = found(points)
    assert surfaces.points.shape == (0, 3)
    assert surfaces.colors.dtype == np.uint8


def test_views_from_one_place_find_nothing():
    turned = [camera((0.0, 0.0, 0.0), (3.0, y, 0.0)) for y in (-0.2, 0.0, 0.2)]
    assert len(found(cameras=turned, paint=grain).points) == 0


def test_what_one_view_finds_alone_does_not_count(monkeypatch):
    depths = [np.zeros((120, 160), np.float32) for _ in AROUND]
    depths[0][:] = 3.0
    monkeypatch.setattr(stereo, "find_depths", lambda *_: depths)
    assert len(found().points) == 0
    depths[2][:] = 3.0
    assert len(found().points) > 0


@pytest.mark.integration
def test_they_are_searched_once_and_only_when_asked_for():
    asked = []
    evidence = Evidence(views_of(AROUND, grain), EDGE, 1.0,
                        lambda: asked.append(1) or tracks_of(EDGE))
    assert asked == []
    assert evidence.once(find_surfaces) is evidence.once(find_surfaces)
    assert asked == [1]


def test_without_any_model_of_sfm_nothing_is_searched():
    assert len(find_surfaces(Evidence(views_of(AROUND, grain), EDGE, 1.0)).points) == 0


def test_of_more_than_there_is_room_for_a_seeded_draw_is_taken():
    points = np.arange(30.0).reshape(10, 3)
    surfaces = SurfacePoints(points, np.arange(30, dtype=np.uint8).reshape(10, 3))
    some = surfaces.at_most(4, seed=1)
    assert len(some.points) == 4
    assert (some.points == some.colors).all()
    assert some.points.tolist() == surfaces.at_most(4, seed=1).points.tolist()
    assert surfaces.at_most(10, seed=1) is surfaces
