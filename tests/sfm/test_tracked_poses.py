import io
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import make_capture

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.job import Reporter
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.poses.tracked_poses import add_prior_poses, adjust_tracked, match_near

CAMERAS = {1}  # whose intrinsics are known


@pytest.fixture
def capture(tmp_path):
    """A capture with exact matches, and its true cameras by name, world to camera."""
    job, truth = make_capture(tmp_path / "capture", frames=24)
    views = {}
    for name in job.names:
        views[name] = np.eye(4)
        views[name][:3] = truth.find_image_with_name(name).cam_from_world().matrix()
    return job, views


def drift(views, *, metres=0.02, degrees=1.0):
    """Poses that drift evenly, in the order of names, as far at the end."""
    result = {}
    for place, name in enumerate(sorted(views)):
        share = place / (len(views) - 1)
        pose = np.linalg.inv(views[name])
        pose[:3, :3] = Rotation.from_rotvec(
            np.radians(degrees) * share * np.array([0.6, 0.0, 0.8])).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += metres * share * np.array([0.0, 0.6, 0.8])
        result[name] = np.linalg.inv(pose)
    return result


def errors(model, views):
    """RMSE of the centres and largest turn (degrees) after a rigid alignment without scale."""
    names = mapper.list_registered(model)
    found = np.array([model.find_image_with_name(name).cam_from_world().inverse().matrix()
                      for name in names])
    true = np.array([np.linalg.inv(views[name]) for name in names])
    ours, theirs = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (found, true))
    turn, _ = Rotation.align_vectors(theirs, ours)
    off = turn.apply(ours) - theirs
    turns = Rotation.from_matrix(
        true[:, :3, :3].transpose(0, 2, 1) @ turn.as_matrix() @ found[:, :3, :3])
    return np.sqrt((off**2).sum(axis=1).mean()), np.degrees(turns.magnitude().max())


@pytest.mark.integration
def test_drifted_poses_come_nearer_to_the_truth_and_keep_their_frame(capture):
    job, views = capture
    given = drift(views)
    found = adjust_tracked(job, given, CAMERAS)
    assert not found.held
    assert not found.replaced
    rmse, turn = errors(found.model, views)
    assert turn < 0.02  # of the 1 degree that was added; the matches are exact
    assert rmse < 0.005
    # nothing was moved as a whole: each camera is within what its prior was off
    for name, view in views.items():
        center = found.model.find_image_with_name(name).projection_center()
        assert np.linalg.norm(center - np.linalg.inv(view)[:3, 3]) < 0.02


@pytest.mark.integration
def test_a_frame_without_matches_is_held_between_its_neighbours(capture):
    job, views = capture
    blank = job.names[10]
    with closing(sqlite3.connect(job.database)) as connection, connection:
        (number,), = connection.execute("SELECT image_id FROM images WHERE name = ?", (blank,))
        base = 2**31 - 1
        connection.execute(
            "DELETE FROM two_view_geometries WHERE pair_id % ? = ? OR pair_id / ? = ?",
            (base, number, base, number))
    given = drift(views)
    found = adjust_tracked(job, given, CAMERAS)
    assert found.held == (blank,)
    add_prior_poses(found.model, found.held, given)
    image = found.model.find_image_with_name(blank)
    other = found.model.find_image_with_name(job.names[9])
    truth = views[blank] @ np.linalg.inv(views[job.names[9]])
    motion = (image.cam_from_world() * other.cam_from_world().inverse()).matrix()
    # it keeps its tracked motion, which drifts by 1/23 of all from one frame to the next
    turn = Rotation.from_matrix(motion[:, :3] @ truth[:3, :3].T).magnitude()
    assert np.degrees(turn) < 1.5 / 23
    assert np.linalg.norm(motion[:, 3] - truth[:3, 3]) < 0.02


@pytest.mark.integration
def test_a_frame_without_a_pose_is_placed_by_its_matches(capture):
    job, views = capture
    given = drift(views)
    del given[job.names[5]]
    found = adjust_tracked(job, given, CAMERAS)
    assert found.replaced == (job.names[5],)
    rmse, turn = errors(found.model, views)
    assert rmse < 0.005
    assert turn < 0.05


def test_frames_whose_poses_their_matches_contradict_are_named(capture):
    job, views = capture
    given = drift(views)
    wrong = job.names[7]
    given[wrong] = np.diag([1.0, -1, -1, 1]) @ given[wrong]
    check = match_near(job, given, Reporter(io.BytesIO()))
    assert check.fits
    assert check.contradicted == (wrong,)


def test_poses_of_other_pictures_do_not_fit(capture):
    job, views = capture
    names = sorted(views)
    others = dict(zip(names, [views[name] for name in [*names[11:], *names[:11]]], strict=True))
    check = match_near(job, others, Reporter(io.BytesIO()))
    assert not check.fits
    assert check.share < 0.5


@pytest.mark.integration
def test_intrinsics_that_are_known_stay(capture):
    job, views = capture
    found = adjust_tracked(job, drift(views), CAMERAS)
    with pycolmap.Database.open(job.database) as opened:
        camera, = opened.read_all_cameras()
    assert found.model.camera(1).params.tolist() == camera.params.tolist()
