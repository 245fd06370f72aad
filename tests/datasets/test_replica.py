
import numpy as np
import posed_sets
import pytest
from facts import raises

from recon_cli.datasets.rgbd import is_replica, read_replica
from recon_cli.errors import FormatError, InputError


@pytest.fixture
def folder(tmp_path):
    return posed_sets.make_replica(tmp_path / "room0")


def test_frames_come_in_order_and_the_test_folder_is_held_out(folder):
    posed = read_replica(folder)
    assert [image.name for image in posed.images] == [
        *(f"frame{number:06d}.jpg" for number in range(4)),
        "test_frame000000.jpg", "test_frame000001.jpg"]
    assert [image.held_out for image in posed.images] == [False] * 4 + [True] * 2
    assert (posed.metric, posed.sequence, posed.splits) == (True, True, True)


def test_poses_are_inverted_and_belong_to_their_frames(folder):
    images = read_replica(folder).images
    for image, place in zip(images, [0, 1, 2, 3, 10, 11], strict=True):
        np.testing.assert_allclose(
            image.viewmat @ posed_sets.pose(place), np.eye(4), atol=1e-8)


def test_the_principal_point_is_moved_by_half_a_pixel(folder):
    (lens,) = read_replica(folder).lenses
    assert lens.params == (posed_sets.FOCAL, posed_sets.FOCAL, posed_sets.CX, posed_sets.CY)


def test_depth_is_paired_by_number_and_read_in_metres(folder):
    images = read_replica(folder).images
    assert [image.depth is not None for image in images] == [True, False, True, False, True, True]
    for image, place in ((images[0], 0), (images[2], 2), (images[5], 11)):
        np.testing.assert_allclose(
            image.depth(), posed_sets.plane_depth(posed_sets.pose(place)), atol=0.5001 / 6553.5)


def test_camera_parameters_may_lie_one_level_up(folder):
    (folder / "cam_params.json").rename(folder.parent / "cam_params.json")
    assert len(read_replica(folder).images) == 6


def test_images_reduced_after_the_camera_was_written_scale_the_lens_and_depth(folder):
    for path in folder.rglob("frame*.jpg"):
        posed_sets.write_image(path, posed_sets.WIDTH // 2, posed_sets.HEIGHT // 2)
    posed = read_replica(folder)
    assert posed.lenses[0].params == (15.0, 15.0, 8.25, 5.5)
    assert any("0.5 times" in notice for notice in posed.notices)
    assert posed.images[0].depth().shape == (posed_sets.HEIGHT // 2, posed_sets.WIDTH // 2)


def test_without_a_test_folder_nothing_is_held_out(tmp_path):
    posed = read_replica(posed_sets.make_replica(tmp_path, tests=0))
    assert not posed.splits
    assert not any(image.held_out for image in posed.images)


def test_frames_left_out_in_between_are_missing_and_the_others_keep_their_poses(folder):
    (folder / "results" / "frame000001.jpg").unlink()
    posed = read_replica(folder)
    assert posed.missing == ("frame000001.jpg",)
    np.testing.assert_allclose(
        posed.images[1].viewmat @ posed_sets.pose(2), np.eye(4), atol=1e-8)


def test_missing_camera_parameters_are_asked_for_with_an_example(folder):
    (folder / "cam_params.json").unlink()
    with raises(FormatError, "cam_params.json") as caught:
        read_replica(folder)
    assert '"scale": 6553.5' in caught.value.hint


def test_a_folder_without_frames_is_refused(tmp_path):
    posed_sets.make_replica(tmp_path, tests=0)
    for path in (tmp_path / "results").iterdir():
        path.unlink()
    assert is_replica(tmp_path)
    with raises(InputError, "frame000000"):
        read_replica(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9])
def test_a_depth_file_cut_short_anywhere_is_refused_when_it_is_read(folder, share):
    path = folder / "results" / "depth000000.png"
    data = path.read_bytes()
    path.write_bytes(data[:int(share * len(data))])
    with raises(FormatError, "depth"):
        read_replica(folder).images[0].depth()


def test_a_depth_file_of_colours_is_refused(folder):
    posed_sets.write_image(folder / "results" / "depth000000.png")
    with raises(FormatError, 24, 32, 3, "shape"):
        read_replica(folder).images[0].depth()


def test_the_rendered_rooms_are_read_whole(shared_data):
    posed = read_replica(shared_data / "rooms" / "office")
    assert len(posed.images) == 112
    assert sum(image.held_out for image in posed.images) == 12
    assert sum(image.depth is not None for image in posed.images) == 32
    assert posed.lenses[0].params == (300, 300, 300, 170)
