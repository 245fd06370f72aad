import numpy as np
import pycolmap
import pytest
from made_model import FOCAL, HEIGHT, WIDTH, MadeModel, along, wall

from recon_cli.sfm.limits import MAX_ERROR_PX
from recon_cli.sfm.verdict.evidence import OFFSETS, explained_matches, gather_evidence


def made(**changes) -> MadeModel:
    return MadeModel(wall(-3, 4, count=400), along([0.0, 0.5, 1.0]), **changes)


def test_exact_matches_all_agree_and_points_are_counted_once_per_image(tmp_path):
    world = made()
    found = gather_evidence(world.model(), world.write_database(tmp_path / "db"), world.names)
    assert found.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert (found.agreeing == found.matches).all()
    assert (found.matches == found.shared[found.pairs[:, 0], found.pairs[:, 1]]).all()
    assert (found.points == found.keypoints).all()
    assert found.centers[:, 0] == pytest.approx([0, 0.5, 1])
    assert not found.shared.diagonal().any()


@pytest.mark.parametrize(("pixels", "whole"), [(OFFSETS[0] - 1, True), (OFFSETS[0] + 1, False)])
def test_a_match_is_explained_up_to_an_offset_across_its_epipolar_line(pixels, whole, tmp_path):
    world = MadeModel(wall(-0.3, 0.8, count=300) * [1, 0.1, 1], along([0.0, 0.5]))
    model = world.model()
    image = model.image(2)
    image.frame.rig_from_world = pitched(pixels / FOCAL) * image.cam_from_world()
    found = gather_evidence(model, world.write_database(tmp_path / "db"), world.names)
    assert found.explained[0] == (found.matches[0] if whole else 0)


def pitched(angle: float) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(
        np.array([np.sin(angle / 2), 0, 0, np.cos(angle / 2)])), np.zeros(3))


def test_a_match_is_explained_at_no_depth_behind_the_cameras_or_too_near():
    """Cameras a metre apart see a point at depth z moved by FOCAL / z pixels to the left."""
    model = MadeModel(wall(-1, 1, count=300), along([0.0, 1.0])).model()
    first, second = model.image(1), model.image(2)
    depths = np.array([np.inf, 10.0, 5.0, 1.0, -5.0])
    ours = np.tile([WIDTH / 2, HEIGHT / 2], (len(depths), 1))
    rise = FOCAL / depths * (0.1 * np.cos(3) - 0.1)
    theirs = ours + np.column_stack([-FOCAL / depths, rise])
    explained = explained_matches(first, ours, second, theirs, 2.0, OFFSETS[0])
    assert explained.tolist() == [True, True, True, False, False]
    explained = explained_matches(first, ours, second, theirs, 0.0, OFFSETS[0])
    assert explained.tolist() == [True, True, True, True, False]


@pytest.mark.parametrize(("pixels", "agree"), [(MAX_ERROR_PX - 1, True), (MAX_ERROR_PX + 3, False)])
def test_a_match_agrees_up_to_the_error_at_which_it_was_accepted(pixels, agree, tmp_path):
    """A camera is turned up by an angle that shifts the middle of its image by so many pixels.

    Sampson's error of one turned camera is the shift over the square root of two.
    """
    world = MadeModel(wall(-0.3, 0.8, count=300) * [1, 0.1, 1], along([0.0, 0.5]))
    model = world.model()
    angle = pixels * np.sqrt(2) / 400
    image = model.image(2)
    image.frame.rig_from_world = pitched(angle) * image.cam_from_world()
    found = gather_evidence(model, world.write_database(tmp_path / "db"), world.names)
    assert found.agreeing[0] == (found.matches[0] if agree else 0)


def test_images_without_a_camera_keep_their_matches_and_agree_with_nothing(tmp_path):
    world = made(unregistered=frozenset({1}))
    found = gather_evidence(world.model(), world.write_database(tmp_path / "db"), world.names)
    assert found.placed.tolist() == [False, True, False]
    assert (found.matches > 0).all()
    assert found.agreeing[[0, 2]].tolist() == [0, 0]
    assert np.isnan(found.centers[1]).all()
    assert found.points[1] == 0


def test_the_order_of_the_names_decides_not_that_of_the_database(tmp_path):
    world = made()
    model, database = world.model(), world.write_database(tmp_path / "db")
    forward, back = (
        gather_evidence(model, database, names) for names in (world.names, world.names[::-1]))
    assert back.pairs.tolist() == forward.pairs.tolist()
    assert back.agreeing.tolist() == forward.agreeing[::-1].tolist()
    assert back.keypoints.tolist() == forward.keypoints[::-1].tolist()


def test_a_pair_that_was_matched_in_vain_counts_as_tried(tmp_path):
    world = MadeModel(
        np.concatenate([wall(-3, 4, count=400), wall(97, 103, count=400)]), along([0.0, 0.5, 100]))
    found = gather_evidence(world.model(), world.write_database(tmp_path / "db"), world.names)
    assert found.pairs.tolist() == [[0, 1]]
    assert found.tried.sum() == 6


def test_only_pairs_that_were_matched_count_as_tried(tmp_path):
    world = made(reach=1)
    found = gather_evidence(world.model(), world.write_database(tmp_path / "db"), world.names)
    assert found.tried.tolist() == [
        [False, True, False], [True, False, True], [False, True, False]]


def test_matches_join_one_point_or_two(tmp_path):
    """First the third camera has points of its own; then the points on the left are gone."""
    world = made(landmark=lambda image, point: (image == 2, point))
    found = gather_evidence(world.model(), world.write_database(tmp_path / "db"), world.names)
    assert found.traced.tolist() == found.matches.tolist()
    assert found.joined.tolist() == [found.matches[0], 0, 0]
    (tmp_path / "db").unlink()
    model = made().model()
    left = [number for number, point in model.points3D.items() if point.xyz[0] < 0]
    for number in left:
        model.delete_point3D(number)
    world = made()
    found = gather_evidence(model, world.write_database(tmp_path / "db"), world.names)
    assert (found.traced < found.matches).all()
    assert found.joined.tolist() == found.traced.tolist()
    assert left
