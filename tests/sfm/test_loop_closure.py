"""A walk there and back whose model goes on in another scale, or that only seems to come back."""

import numpy as np
import pytest
from made_model import FOCAL, MadeModel, along, wall

from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.features import matching
from recon_cli.sfm.segments.edge_information import SCALES, measure_information
from recon_cli.sfm.segments.loop_closure import move_frames, optimize_model, optimize_segments
from recon_cli.sfm.segments.shared_points import describe_segment, find_shared_points

TURN = 24  # the frame from which on the walk comes back
STAY = Similarity()


def there_and_back(**changes):
    """Cameras along a wall with depth and back; what they see on the way back are other points."""
    steps = np.concatenate([np.arange(TURN), TURN - 1.5 - np.arange(TURN)]) * 0.3
    points = wall(-4, 11, count=900)
    points[:, 2] += np.random.default_rng(1).uniform(-1.5, 1.5, len(points))
    return MadeModel(
        points, along(steps), **{"landmark": lambda image, point: (image >= TURN, point),
                                 "reach": 60, **changes})


def broken(made, motion):
    """The model of a walk with all that comes after the turn moved."""
    return move_frames(made.model(), {
        name: motion if index >= TURN else STAY for index, name in enumerate(made.names)})


def about(place, scale, degrees=0.0):
    """A similarity about a place that turns about the vertical."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0],
                     [-np.sin(angle), 0, np.cos(angle)]])
    return Similarity(scale, turn, place - scale * turn @ place)


def errors(model, made):
    """Distances of the cameras from the true ones."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda each: each.name)
    found = np.array([image.projection_center() for image in images])
    return np.linalg.norm(found - [pose.inverse().translation for pose in made.poses], axis=1)


@pytest.fixture
def made():
    return there_and_back()


def matches_of(made, folder):
    return matching.read_verified(made.write_database(folder / "database.db"))


@pytest.mark.integration
def test_a_model_that_is_right_is_left_as_it_is(made, tmp_path):
    assert optimize_model(made.model(), matches_of(made, tmp_path), seed=0) is None


@pytest.mark.integration
@pytest.mark.parametrize(("scale", "degrees"), [(1.37, 0), (0.75, 0), (1.1, 6)])
def test_a_loop_takes_a_break_of_scale_back(made, tmp_path, scale, degrees):
    turn = made.poses[TURN].inverse().translation
    model = broken(made, about(turn, scale, degrees))
    assert errors(model, made).max() > 0.5
    closed = optimize_model(model, matches_of(made, tmp_path), seed=0)
    assert errors(closed, made).max() < 0.1  # a tenth of the break, and more


@pytest.mark.integration
def test_what_only_looks_alike_closes_no_loop(made, tmp_path):
    model = broken(made, about(made.poses[TURN].inverse().translation, 1.0, 60))
    assert optimize_model(model, matches_of(made, tmp_path), seed=0) is None


def test_moved_frames_see_their_points_where_they_saw_them(made):
    model = broken(made, about(np.array([1.0, 2, 3]), 1.5, 30))
    image = model.image(40)
    shown = [point for point in image.points2D if point.has_point3D()]
    places = np.array([image.cam_from_world() * model.point3D(point.point3D_id).xyz
                       for point in shown])
    pixels = FOCAL * places[:, :2] / places[:, 2:] + [300, 200]
    np.testing.assert_allclose(pixels, [point.xy for point in shown], atol=1e-6)


def test_a_walk_is_weakest_where_no_point_is_seen_from_both_sides(made):
    known = measure_information(made.model(), made.names)
    assert known.turn.argmax() == TURN - 1
    assert known.scale[TURN - 1] == SCALES[1]
    assert np.median(known.scale) < 0.05


@pytest.mark.integration
def test_segments_meet_in_their_common_frames_and_close_their_loop(tmp_path):
    parts = [there_and_back(landmark=lambda _, point: point, unregistered=frozenset(missing))
             for missing in (range(28, 48), range(20))]
    made = parts[0]
    segments = [describe_segment(index, part.model()) for index, part in enumerate(parts)]
    matches = matches_of(made, tmp_path)
    common = find_shared_points(segments, matches)
    start = {0: STAY, 1: about(made.poses[TURN].inverse().translation, 1.3, 4)}
    closed = optimize_segments(segments, start, common, matches, seed=0)
    assert closed.residuals[0, 1] < 1
    for name, pose in zip(made.names, made.poses, strict=True):
        center = pose.inverse().translation
        for index in (0, 1):
            if (index, name) in closed.poses:
                assert np.linalg.norm(closed.poses[index, name].points(center) - center) < 0.1
