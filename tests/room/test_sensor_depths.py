"""Depth of a sensor in the maps of a mesh, on a wall that is known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from walls import AROUND, HEIGHT, WIDTH, errors, grain, views_of, wall

from recon_cli.context import StageContext
from recon_cli.room.depth_maps import weigh
from recon_cli.room.mesh import mesh_of
from recon_cli.room.sensor_depths import with_sensor
from recon_cli.room.volume import pixel_rays
from recon_cli.scene.train_view import SensorDepth

NOISE = 0.02
EVERY = range(len(AROUND))
rng = np.random.default_rng(0)


def sensor(camera, depth, noise=NOISE, step=2, share=1.0):
    """Samples of every second pixel of an image [H, W], up to a share of its width."""
    row, column = np.mgrid[0:camera.height:step, 0:camera.width:step].reshape(2, -1)
    rays = pixel_rays(camera)[row, column][:, :2].astype(np.float32)
    z = (depth[row, column] * (1 + noise * rng.normal(size=len(row)))).astype(np.float32)
    used = column < share * camera.width
    return SensorDepth(rays[used], z[used], noise, len(row))


def maps_of(off=1.0, seen=EVERY, **more):
    """Maps of the wall by the Gaussians, off by a factor, and views of which some have depth."""
    depths = [wall(view, 0.0)[0] for view in AROUND]
    views = [replace(view, depth=sensor(view.camera, depth, **more)) if row in seen else view
             for row, (view, depth) in enumerate(
                 zip(views_of(AROUND, grain), depths, strict=True))]
    return weigh(views, AROUND, [off * depth for depth in depths],
                 [np.ones_like(depth) for depth in depths])


def test_a_view_with_a_sensor_gets_a_map_with_less_than_its_noise():
    maps = with_sensor(maps_of(seen=(2, 5)))
    assert len(maps.depths) == len(AROUND) + 2
    added = maps.depths[len(AROUND):]
    assert all(one.shape == (HEIGHT // 2, WIDTH // 2) for one in added)
    error, share = errors(maps.cameras[len(AROUND):], added)
    assert share > 0.99
    assert np.median(error) < NOISE / 3  # of the mean of 25


@pytest.mark.integration
def test_what_others_say_differently_counts_nothing_where_the_sensor_knows():
    maps = with_sensor(maps_of(off=1.2, seen=(0,), share=0.5))
    assert not maps.gains[0][:, :WIDTH // 2 - 2].any()
    assert maps.gains[0][:, WIDTH // 2 + 2:].all()
    assert maps.gains[1].all()
    agreeing = with_sensor(maps_of(off=1.01, seen=(0,)))
    assert (agreeing.gains[0] > 0).mean() > 0.99


def test_maps_without_a_sensor_are_as_they_were():
    maps = maps_of(seen=())
    assert with_sensor(maps) is maps


def test_a_sensor_of_a_handful_of_pixels_makes_no_map():
    maps = maps_of(step=10)
    assert with_sensor(maps) is maps


@pytest.mark.integration
def test_the_mesh_lies_where_the_sensor_sees_the_wall():
    ctx = StageContext(backend="numba", threads=1)
    off = {}
    for name, maps in (("without", maps_of(off=1.1, seen=())),
                       ("with", with_sensor(maps_of(off=1.1)))):
        mesh = mesh_of(maps, None, ctx, max_triangles=10_000, voxel=0.03).mesh
        off[name] = float(np.median(np.abs(mesh.vertices[:, 0] - 3.0)))
    assert off["without"] > 0.2
    assert off["with"] < 0.01
