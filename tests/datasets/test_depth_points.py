from dataclasses import replace

import numpy as np
import posed_sets
import pytest
from facts import raises
from PIL import Image

from recon_cli.datasets.depth_points import points_from_depth
from recon_cli.datasets.rgbd import read_replica
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.camera import Lens


@pytest.fixture
def posed(tmp_path):
    return read_replica(posed_sets.make_replica(tmp_path))


def test_points_of_a_plane_lie_on_it_with_the_colour_of_the_image(posed):
    points, colors = points_from_depth(posed)
    # Depth is rounded to 1/6553.5 m, and the plane's normal is 1.02 long.
    np.testing.assert_allclose(points @ posed_sets.NORMAL, posed_sets.OFFSET, atol=1e-4)
    np.testing.assert_allclose(colors, np.tile([200, 100, 50], (len(points), 1)), atol=2)


def test_each_pixel_is_unprojected_through_its_centre(posed):
    only = replace(posed, images=posed.images[:1])
    points, _ = points_from_depth(only)
    camera = points @ only.images[0].viewmat[:3, :3].T + only.images[0].viewmat[:3, 3]
    lens = posed.lenses[0].params
    at = camera[:, :2] / camera[:, 2:] * lens[:2] + lens[2:]
    rows, columns = np.divmod(np.arange(posed_sets.WIDTH * posed_sets.HEIGHT), posed_sets.WIDTH)
    np.testing.assert_allclose(at, np.stack([columns, rows], axis=1) + 0.5, atol=1e-9)


def test_colours_belong_to_their_points(tmp_path):
    posed = read_replica(posed_sets.make_replica(tmp_path, frames=1, tests=0))
    ramp = np.zeros((posed_sets.HEIGHT, posed_sets.WIDTH, 3), np.uint8)
    ramp[..., 0] = np.arange(posed_sets.WIDTH) * 4
    ramp[..., 2] = np.arange(posed_sets.HEIGHT)[:, None] * 4
    Image.fromarray(ramp).save(tmp_path / "results" / "frame000000.png")
    image = replace(posed.images[0], path=tmp_path / "results" / "frame000000.png")
    _, colors = points_from_depth(replace(posed, images=(image,)))
    np.testing.assert_array_equal(colors, ramp.reshape(-1, 3))


def test_a_distorted_lens_is_undone(posed):
    lens = Lens("OPENCV", posed_sets.WIDTH, posed_sets.HEIGHT, (
        *posed.lenses[0].params, 0.1, 0.0, 0.0, 0.0))
    straight, _ = points_from_depth(replace(posed, images=posed.images[:1]))
    bent, _ = points_from_depth(replace(posed, images=(replace(posed.images[0], lens=lens),)))
    ray = bent[0] - posed_sets.pose(0)[:3, 3]
    x, y = ray[:2] / ray[2]
    stretched = np.array([x, y]) * (1 + 0.1 * (x * x + y * y))
    ray = straight[0] - posed_sets.pose(0)[:3, 3]
    np.testing.assert_allclose(stretched, ray[:2] / ray[2], atol=1e-9)


def test_held_out_images_give_no_points(posed):
    with raises(InputError, 0, "frames"):
        points_from_depth(replace(posed, images=posed.images[4:]))


def test_there_are_no_more_points_than_asked_for_and_they_are_spread_evenly(posed):
    points, colors = points_from_depth(posed, max_points=50)
    assert 25 <= len(points) <= 50
    assert len(colors) == len(points)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    nearest = np.sort(apart, axis=1)[:, 1]
    assert np.median(nearest) > 0.2  # 50 points on about 4 x 3 m lie half a metre apart


def test_the_same_set_gives_the_same_points(posed):
    first, again = (points_from_depth(posed, max_points=50) for _ in range(2))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


def test_depth_without_a_value_is_refused(posed):
    empty = replace(posed.images[0], depth=lambda: np.zeros(
        (posed_sets.HEIGHT, posed_sets.WIDTH), np.float32))
    with raises(InputError, 1, "frames"):
        points_from_depth(replace(posed, images=(empty,)))


def test_an_image_that_is_gone_is_named(posed):
    posed.images[2].path.unlink()
    with raises(FormatError, "frame000002"):
        points_from_depth(posed)


@pytest.mark.integration
def test_points_of_a_room_lie_on_the_surfaces_that_other_views_see(shared_data):
    posed = read_replica(shared_data / "rooms" / "office")
    points, _ = points_from_depth(posed)
    assert 90_000 < len(points) <= 100_000
    fx, fy, cx, cy = posed.lenses[0].params
    off = []
    for image in posed.images[100:]:
        depth = image.depth()
        camera = points @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
        camera = camera[camera[:, 2] > 0.1]
        x = np.floor(camera[:, 0] / camera[:, 2] * fx + cx).astype(int)
        y = np.floor(camera[:, 1] / camera[:, 2] * fy + cy).astype(int)
        seen = (x >= 0) & (x < 600) & (y >= 0) & (y < 340)
        off.append(np.abs(depth[y[seen], x[seen]] - camera[seen, 2]))
    # Points that another view cannot see are far off, and still fewer than half of all.
    assert np.median(np.concatenate(off)) < 0.01
