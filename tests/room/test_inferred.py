"""Holes in the planes of a mesh: closed where surface surrounds them, left where rays passed."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_stages import CONTEXT

from recon_cli.io.mesh_data import Mesh, joined
from recon_cli.room.depth_maps import weigh
from recon_cli.room.inferred import _is_surrounded, infer_surface
from recon_cli.room.mesh import mesh_of
from recon_cli.room.volume import pixel_rays
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView

VOXEL = 0.04
HALF = 1.0  # of the wall at x = 2
HOLE = 0.3  # half the side of its hole, in the middle
UP = np.array([0.0, 0.0, 1.0])


def camera(y: float, z: float, size: int = 96) -> Camera:
    viewmat = looking_at(np.array([0.0, y, z]), np.array([2.0, 0.0, 0.0]), UP)
    return Camera(size, size, 0.8 * size, 0.8 * size, size / 2, size / 2, viewmat)


CAMERAS = [camera(y, z) for y in (-0.4, 0.0, 0.4) for z in (-0.3, 0.3)]


def wall(hole, *, half: float = HALF) -> Mesh:
    """The wall in cells of a voxel, without those whose middle (y, z) is in the hole."""
    side = np.arange(-half, half + VOXEL / 2, VOXEL)
    count = len(side) - 1
    y, z = (grid.ravel() for grid in np.meshgrid(side, side))
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(count)))
    there = ~hole(side[column] + VOXEL / 2, side[row] + VOXEL / 2)
    a = (row * (count + 1) + column)[there]
    b, c, d = a + 1, a + count + 1, a + count + 2
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    vertices = np.stack([np.full(len(y), 2.0), y, z], axis=1)
    return Mesh(vertices, faces.astype(np.int64), np.zeros((len(y), 3), np.uint8))


def square(y, z):
    return (np.abs(y) < HOLE) & (np.abs(z) < HOLE)


def maps_of(depth_at, cameras=CAMERAS):
    """Depth maps of the plane x = `depth_at`(y, z), of places in the wall; 0 for no depth."""
    depths = []
    for view in cameras:
        rays = pixel_rays(view) @ view.viewmat[:3, :3]
        place = view.center + rays * (2 / rays[..., 0])[..., None]
        depths.append(np.asarray(depth_at(place[..., 1], place[..., 2]) / rays[..., 0], np.float32))
    views = [TrainView(view, np.full((view.height, view.width, 3), 90, np.uint8))
             for view in cameras]
    return weigh(views, cameras, depths, [np.ones_like(depth) for depth in depths])


def blank(y, _z):
    return np.full_like(y, 2.0)


def area(mesh: Mesh) -> float:
    return mesh.area()


def test_a_hole_that_its_wall_surrounds_is_closed_in_the_wall():
    found = infer_surface(wall(square), maps_of(blank), VOXEL)
    assert found.inferred.all()
    assert np.abs(found.vertices[:, 0] - 2.0).max() < 1e-6
    assert np.abs(found.vertices[:, 1:]).max() <= HOLE + 2 * VOXEL + 1e-9  # and its rim
    assert (2 * HOLE) ** 2 < area(found) < (2 * HOLE + 3 * VOXEL) ** 2
    corners = found.vertices[found.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 0] < 0).all()  # towards the cameras, as the wall


@pytest.mark.parametrize("depth_at", [
    lambda y, z: np.where(square(y, z), 5.0, 2.0),  # a window: rays pass
    lambda y, z: np.where(square(y, z), 0.0, 2.0),  # nothing is known there
    lambda y, z: np.where(square(y, z), 2.3, 2.0),  # a niche
], ids=["window", "unknown", "niche"])
def test_a_hole_that_views_do_not_confirm_stays_open(depth_at):
    assert infer_surface(wall(square), maps_of(depth_at), VOXEL) is None


def in_hole(*depths):
    """Depth maps of a wall, whose hole has one of the depths in each view."""
    maps = maps_of(blank)
    for row, depth in enumerate(depths):
        own = maps_of(lambda y, z, depth=depth: np.where(square(y, z), depth, 2.0))
        maps.depths[row] = own.depths[row]
    return maps


def test_a_hole_that_one_view_in_six_looks_through_stays_open():
    assert infer_surface(wall(square), in_hole(5.0), VOXEL) is None


def test_one_view_shows_a_hole_that_the_others_know_nothing_of():
    found = infer_surface(wall(square), in_hole(2.0, 0.0, 0.0, 0.0, 0.0, 0.0), VOXEL)
    assert area(found) > 0.9 * (2 * HOLE) ** 2
    assert infer_surface(
        wall(square), in_hole(2.0, 5.0, 0.0, 0.0, 0.0, 0.0), VOXEL) is None  # and one looks through


def test_a_bay_at_the_rim_of_a_wall_stays_open():
    bay = wall(lambda y, z: (np.abs(y) < HOLE) & (z > -HOLE))
    assert infer_surface(bay, maps_of(blank), VOXEL) is None


def test_a_bay_that_another_plane_closes_is_filled_up_to_it():
    bay = wall(lambda y, z: (np.abs(y) < HOLE) & (z > HOLE))
    side = np.arange(-HALF, HALF + VOXEL / 2, VOXEL)
    x, y = (grid.ravel() for grid in np.meshgrid(2.0 - VOXEL * np.arange(len(side)), side))
    count = len(side)
    row, column = (g.ravel() for g in np.meshgrid(np.arange(count - 1), np.arange(count - 1)))
    a = row * count + column
    faces = np.concatenate([np.stack([a, a + 1, a + count], 1),
                            np.stack([a + 1, a + count + 1, a + count], 1)])  # downwards
    ceiling = np.stack([x, y, np.full(len(x), HALF)], axis=1)
    both = Mesh(np.concatenate([bay.vertices, ceiling]),
                np.concatenate([bay.faces, faces + len(bay.vertices)]),
                np.zeros((len(bay.vertices) + len(ceiling), 3), np.uint8))
    found = infer_surface(both, maps_of(blank), VOXEL)
    assert np.abs(found.vertices[:, 0] - 2.0).max() < 1e-6
    assert found.vertices[:, 2].max() <= HALF + VOXEL + 1e-9
    assert area(found) > 0.8 * 2 * HOLE * (HALF - HOLE)


def test_a_bay_is_filled_up_to_the_line_of_a_plane_whose_surface_ends_before_it():
    bay = wall(lambda y, z: (np.abs(y) < HOLE) & (z > HOLE))
    x, y = (grid.ravel() for grid in np.meshgrid(
        2.0 - VOXEL * np.arange(60), np.arange(-HALF, HALF + VOXEL / 2, VOXEL), indexing="ij"))
    count = len(np.unique(y))
    row, column = (g.ravel() for g in np.meshgrid(np.arange(59), np.arange(count - 1)))
    middle = np.abs(y[row * count + column] + VOXEL / 2) < HOLE + 3 * VOXEL
    a = (row * count + column)[~(middle & (row < 10))]  # it too is open at the bay
    faces = np.concatenate([np.stack([a, a + 1, a + count], 1),
                            np.stack([a + 1, a + count + 1, a + count], 1)])
    normals = np.cross(*(np.array([[0, VOXEL, 0], [-VOXEL, 0, 0]])))
    faces = faces if normals[2] < 0 else faces[:, ::-1]
    ceiling = np.stack([x, y, np.full(len(x), HALF)], axis=1)
    both = Mesh(np.concatenate([bay.vertices, ceiling]),
                np.concatenate([bay.faces, faces + len(bay.vertices)]),
                np.zeros((len(bay.vertices) + len(ceiling), 3), np.uint8))
    found = infer_surface(both, maps_of(blank), VOXEL)
    in_bay = found.vertices[np.abs(found.vertices[:, 0] - 2.0) < 1e-6]
    assert in_bay[:, 2].max() <= HALF + 2 * VOXEL + 1e-9
    assert in_bay[:, 2].max() > HALF - 2 * VOXEL
    assert np.ptp(in_bay[:, 1]) > 2 * HOLE - VOXEL


def test_a_table_at_a_wall_gets_no_ledge_along_it():
    whole = wall(lambda y, _: y > 9)
    x, y = (grid.ravel() for grid in np.meshgrid(
        2.0 - VOXEL * np.arange(16), VOXEL * np.arange(-8, 9), indexing="ij"))
    row, column = (g.ravel() for g in np.meshgrid(np.arange(15), np.arange(16)))
    a = row * 17 + column
    faces = np.concatenate([np.stack([a, a + 17, a + 1], 1),
                            np.stack([a + 1, a + 17, a + 18], 1)])[:, ::-1]  # upwards
    table = np.stack([x, y, np.zeros(len(x))], axis=1)
    a, b, c = table[faces[0]]
    assert np.cross(b - a, c - a)[2] > 0
    both = Mesh(np.concatenate([whole.vertices, table]),
                np.concatenate([whole.faces, faces + len(whole.vertices)]),
                np.zeros((len(whole.vertices) + len(table), 3), np.uint8))
    found = infer_surface(both, maps_of(blank), VOXEL)
    assert found is None or np.abs(found.vertices[:, 1]).max() < 8 * VOXEL + 4 * VOXEL


def test_a_hole_is_surrounded_only_if_something_lies_near_in_all_eight_directions():
    cells = np.zeros((40, 40), bool)
    cells[10, 10:31] = cells[30, 10:31] = cells[10:31, 10] = cells[10:31, 30] = True
    assert _is_surrounded(cells)[11:30, 11:30].all()
    cells[30] = False  # one side is open
    assert not _is_surrounded(cells)[11:30, 11:30].any()


def test_what_furniture_hides_stays_open():
    box = np.array([[1.0, y, z] for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    mesh = wall(square)
    hidden = Mesh(np.concatenate([mesh.vertices, box]), np.concatenate([
        mesh.faces, np.array([[0, 1, 2], [1, 3, 2]]) + len(mesh.vertices)]),
        np.zeros((len(mesh.vertices) + 4, 3), np.uint8))
    assert infer_surface(hidden, maps_of(blank), VOXEL) is None


def test_a_mesh_without_holes_gets_nothing():
    assert infer_surface(wall(lambda y, _: y > 9), maps_of(blank), VOXEL) is None


def test_a_mesh_closes_holes_only_if_it_is_asked_to():
    result = mesh_of(maps_of(blank), None, CONTEXT, max_triangles=10**5, voxel=VOXEL)
    assert result.inferred is None
    again = mesh_of(
        maps_of(blank), None, CONTEXT, max_triangles=10**5, voxel=VOXEL, infer=True)
    assert np.array_equal(again.mesh.vertices, result.mesh.vertices)


@pytest.mark.integration
@pytest.mark.parametrize("most", [20, 200])
def test_what_is_inferred_counts_among_the_triangles_that_are_allowed(most):
    whole, result = (mesh_of(
        in_hole(2.0, 0.0, 0.0, 0.0, 0.0, 0.0), None, CONTEXT, max_triangles=count, voxel=VOXEL,
        infer=True) for count in (10**5, most))
    assert len(whole.mesh.faces) > most < len(whole.inferred.faces)
    assert 0 < len(result.mesh.faces) + len(result.inferred.faces) <= most
    assert result.inferred.inferred.all()
    assert joined(result.mesh, result.inferred).area() == pytest.approx(
        joined(whole.mesh, whole.inferred).area(), rel=0.1)
