"""The mesh of depth maps that are known exactly: what it meets, what it leaves open or out."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from facts import assert_facts, raises
from tiny_stages import CONTEXT

from recon_cli.errors import ReconstructionError
from recon_cli.room import mesh as build
from recon_cli.room.depth_maps import weigh
from recon_cli.room.mesh import mesh_of
from recon_cli.room.volume import extract, fuse, pixel_rays
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView

UP = np.array([0.0, 0.0, 1.0])


def camera(eye, target, size=96):
    viewmat = looking_at(np.array(eye, float), np.array(target, float), UP)
    return Camera(size, size, 0.8 * size, 0.8 * size, size / 2, size / 2, viewmat)


def wall_depth(view: Camera, x: float = 2.0) -> np.ndarray:
    """Depth of the wall at x, 1.6 m wide and high, and of nothing beside it."""
    rays = pixel_rays(view) @ view.viewmat[:3, :3]
    depth = (x - view.center[0]) / np.where(rays[..., 0] > 0.05, rays[..., 0], np.inf)
    place = view.center + rays * depth[..., None]
    return np.where(np.abs(place[..., 1:]).max(-1) < 0.8, depth, 0).astype(np.float32)


def ball_depth(view: Camera, radius: float = 0.5) -> np.ndarray:
    rays = pixel_rays(view) @ view.viewmat[:3, :3]
    a, b = (rays * rays).sum(-1), rays @ view.center
    inside = b * b - a * (view.center @ view.center - radius**2)
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0).astype(np.float32)


def maps_of(cameras, depth_of, color=(200, 100, 50)):
    depths = [depth_of(view) for view in cameras]
    views = [TrainView(view, np.full((view.height, view.width, 3), color, np.uint8))
             for view in cameras]
    return weigh(views, cameras, depths, [(depth > 0).astype(np.float32) for depth in depths])


ROUND = [camera((2 * np.cos(angle), 2 * np.sin(angle), height), (0, 0, 0))
         for angle in np.arange(0, 2 * np.pi, 0.5) for height in (-1.0, 0.2, 1.2)]
FRONT = [camera((0.0, y, z), (2.0, 0.0, 0.0)) for y in (-0.4, 0.0, 0.4) for z in (-0.3, 0.3)]


def test_a_ball_seen_from_all_around_is_closed_and_as_large_as_it_is():
    maps = maps_of(ROUND, ball_depth)
    vertices, faces = extract(fuse(maps, 0.03, 4.0))
    off = np.linalg.norm(vertices, axis=1) - 0.5
    assert np.abs(np.median(off)) < 0.003
    assert np.percentile(np.abs(off), 99) < 0.02
    corners = vertices[faces]
    outwards = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                * corners.mean(1)).sum(-1)
    assert (outwards > 0).mean() > 0.99


def test_a_room_to_be_measured_has_its_planes_and_what_points_say_of_them():
    grid = np.linspace(-0.7, 0.7, 15)
    points = np.stack(np.meshgrid([2.01], grid, grid), axis=-1).reshape(-1, 3)
    result = mesh_of(maps_of(FRONT, wall_depth), points, CONTEXT, max_triangles=100, voxel=0.04)
    [(plane, confirmed)] = result.planes
    assert abs(plane.offset) == pytest.approx(2.0, abs=0.01)
    assert abs(confirmed.offset) == pytest.approx(2.01, abs=1e-6)


def test_one_wall_is_one_sheet_with_open_rims():
    result = mesh_of(maps_of(FRONT, wall_depth), None, CONTEXT, max_triangles=10**6, voxel=0.04)
    vertices, faces = result.mesh.vertices, result.mesh.faces
    assert np.abs(vertices[:, 0] - 2.0).max() < 0.01
    assert np.abs(vertices[:, 1:]).max() < 0.9
    assert result.planes == []
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(1.6**2, rel=0.12)  # doubled surface would have twice as much
    edges = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert (counts == 1).any()
    assert (result.mesh.colors == (200, 100, 50)).all()


def test_what_one_view_alone_claims_is_no_surface():
    def with_floater(view):
        depth = wall_depth(view)
        if view is FRONT[0]:
            depth[10:40, 10:40] = 0.7
        return depth

    result = mesh_of(
        maps_of(FRONT, with_floater), None, CONTEXT, max_triangles=10**6, voxel=0.04)
    assert np.abs(result.mesh.vertices[:, 0] - 2.0).max() < 0.02


def test_ten_triangles_are_enough_for_a_wall():
    result = mesh_of(maps_of(FRONT, wall_depth), None, CONTEXT, max_triangles=10, voxel=0.04)
    assert 0 < len(result.mesh.faces) <= 10 < result.triangles_before
    assert np.abs(result.mesh.vertices[:, 0] - 2.0).max() < 0.1


def test_a_mesh_that_does_not_fit_gets_coarser_voxels_with_a_notice(monkeypatch):
    notices: list[str] = []
    ctx = copy.copy(CONTEXT)
    object.__setattr__(ctx, "notice", notices.append)
    maps = maps_of(FRONT, wall_depth)
    fine = len(fuse(maps, 0.02, 8.0).blocks) * build.BYTES
    monkeypatch.setattr(build, "_MOST_BYTES", fine / 3)
    result = mesh_of(maps, None, ctx, max_triangles=10**6, voxel=0.02)
    assert 0.02 < result.voxel < 0.08
    assert_facts("\n".join(notices), "0.02")
    monkeypatch.setattr(build, "_MOST_BYTES", 10)
    with raises(ReconstructionError, "memory"):
        mesh_of(maps_of(FRONT, wall_depth), None, ctx, max_triangles=100, voxel=0.02)


def test_views_that_do_not_agree_make_no_mesh():
    def random_depth(view):
        rng = np.random.default_rng(int(1e6 * abs(view.center[1] + 3 * view.center[2])))
        return rng.uniform(0.5, 8.0, (view.height, view.width)).astype(np.float32)

    with raises(ReconstructionError, "surface"):
        mesh_of(maps_of(FRONT[:2], random_depth), None, CONTEXT, max_triangles=1000, voxel=0.04)
