import numpy as np
import posed_sets
import pytest
from facts import assert_facts, raises

from recon_cli.datasets.rgbd import read_scannet
from recon_cli.errors import FormatError, InputError


@pytest.fixture
def folder(tmp_path):
    return posed_sets.make_scannet(tmp_path)


def test_frames_come_in_the_order_of_their_numbers_without_lost_ones(tmp_path):
    posed = read_scannet(posed_sets.make_scannet(tmp_path, frames=12, lost=(1, 3)))
    assert [image.name for image in posed.images] == [
        f"{number}.jpg" for number in (0, 2, *range(4, 12))]
    (notice,) = posed.notices
    assert_facts(notice, 2, "1.jpg")
    assert (posed.metric, posed.sequence, posed.splits) == (True, True, False)


def test_poses_are_inverted_and_the_principal_point_moved(folder):
    posed = read_scannet(folder)
    np.testing.assert_allclose(
        posed.images[1].viewmat @ posed_sets.pose(2), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(posed.lenses[0].params, (30.0, 30.0, 16.5, 11.0), atol=1e-12)


def test_depth_of_half_the_size_is_looked_up_in_the_nearest_pixel(folder):
    depth = read_scannet(folder).images[0].depth()
    half = posed_sets.plane_depth(
        posed_sets.pose(0), posed_sets.WIDTH // 2, posed_sets.HEIGHT // 2, 15.0, 8.25, 5.5)
    np.testing.assert_allclose(depth, half.repeat(2, axis=0).repeat(2, axis=1), atol=0.0006)


def test_depth_that_sees_less_than_the_colours_is_empty_outside(tmp_path):
    posed_sets.make_scannet(tmp_path)
    path = tmp_path / "intrinsic" / "intrinsic_depth.txt"
    K = np.loadtxt(path)
    K[0, 0] *= 2  # twice the focal length: half the field of view
    K[1, 1] *= 2
    np.savetxt(path, K)
    depth = read_scannet(tmp_path).images[0].depth()
    assert (depth[:, :8] == 0).all()
    assert (depth[8:16, 12:20] > 0).all()


def test_a_scene_whose_tracking_was_lost_throughout_is_refused(tmp_path):
    posed_sets.make_scannet(tmp_path, lost=range(4))
    with raises(InputError, 4, "tracking"):
        read_scannet(tmp_path)


def test_a_scene_without_depth_is_read_without(folder):
    for path in (folder / "depth").iterdir():
        path.unlink()
    assert all(image.depth is None for image in read_scannet(folder).images)


def test_intrinsics_for_images_of_another_size_are_refused(folder):
    K = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")
    K[:2] *= 2
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    with raises(FormatError, "size"):
        read_scannet(folder)
