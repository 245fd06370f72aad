import itertools
import json
import re

import cv2
import numpy as np
import pytest
from facts import assert_facts, raises
from scipy.spatial.transform import Rotation
from sfm_inputs import every_nth, run, run_here, texture, write_inputs

from recon_cli.errors import ConfigError, SfmError
from recon_cli.io.colmap import read_images, read_points, read_scene
from recon_cli.io.images import read_png, write_png
from recon_cli.scene.camera import Lens
from recon_cli.sfm import database
from recon_cli.workspace.records import Frame, FrameList, Group, KnownPoses
from recon_cli.workspace.summaries import PlaceSummary, PosesSummary

STEP, COUNT = 4, 9  # every 4th frame of the sample
LENS = Lens("PINHOLE", 600, 340, (300.0, 300.0, 300.0, 170.0))  # what the room was rendered with
POSELESS = "000032.png"


@pytest.fixture(scope="module")
def room(tmp_path_factory, sample_video):
    """Nine frames of the sample room with a known lens."""
    images = every_nth(sample_video, STEP, COUNT)
    base = write_inputs(tmp_path_factory.mktemp("room"), images)
    FrameList("nerfstudio", (Group("room", 600, 340, lens=LENS),), tuple(
        Frame(name, None, name, None, held_out=False) for name in images)).write(base / "ingest")
    return base


@pytest.fixture(scope="module")
def truth(shared_data):
    """World to camera of each frame, by name, in metres."""
    lines = (shared_data / "rooms" / "office" / "traj.txt").read_text().splitlines()
    return {
        f"{index:06d}.png": np.linalg.inv(np.array(lines[index].split(), float).reshape(4, 4))
        for index in range(0, STEP * COUNT, STEP)}


@pytest.fixture
def given(room):
    """Writes poses, and points, into ingest; they are gone after the test."""
    def write(viewmats, points=None, *, tracked=False):
        colors = None if points is None else np.full((len(points), 3), 128, np.uint8)
        KnownPoses(
            viewmats, True, points, colors, up=(0.0, 0.0, 1.0) if tracked else None,
            accuracy="tracked" if tracked else "solved").write(room / "ingest")

    yield write
    for path in (room / "ingest").glob("po*s.*"):
        path.unlink()


def found(out):
    return {name: viewmat for name, _, viewmat in read_images(out / "sparse" / "images.bin")}


@pytest.mark.integration
def test_poses_and_points_that_are_kept_are_written_as_they_were_given(
    room, truth, given, tmp_path
):
    points = np.random.default_rng(0).normal(size=(50, 3))
    given(truth, points)
    summary = run(room, tmp_path / "out")
    for name, viewmat in found(tmp_path / "out").items():
        np.testing.assert_allclose(viewmat, truth[name], atol=1e-12)
    scene = read_scene(tmp_path / "out" / "undistorted", held_out=frozenset(), validation=0.0)
    np.testing.assert_allclose(
        np.sort(scene.points, axis=0), np.sort(points, axis=0), atol=1e-6)
    assert summary.registered == COUNT
    assert summary.points == 50
    assert summary.reprojection_error_px is None
    text = json.dumps(summary.to_json(), allow_nan=False)
    assert PlaceSummary.from_json(json.loads(text)) == summary
    assert not (tmp_path / "out" / "database.db").exists()


@pytest.mark.integration
def test_kept_poses_are_held_against_some_of_the_images(room, truth, given, tmp_path):
    given(truth, np.random.default_rng(0).normal(size=(50, 3)))
    line, = run_here(room, tmp_path / "out").lines
    share, matches = re.match(r"(\d+)% of (\d+) matches between sampled images", line).groups()
    assert int(share) > 80
    assert int(matches) > 500


@pytest.mark.integration
@pytest.mark.parametrize("change", ["flipped axes", "shuffled"])
def test_wrong_poses_are_refused_although_points_came_with_them(
    room, truth, given, tmp_path, change
):
    wrong = {name: np.diag([1.0, -1, -1, 1]) @ viewmat for name, viewmat in truth.items()}
    if change == "shuffled":
        names = sorted(truth)
        wrong = dict(zip(names, [truth[name] for name in [*names[4:], *names[:4]]], strict=True))
    given(wrong, np.random.default_rng(0).normal(size=(50, 3)))
    with raises(SfmError, "poses", "images"):
        run_here(room, tmp_path / "out")
    assert not (tmp_path / "out" / "sparse").exists()


@pytest.mark.integration
def test_wrong_poses_that_are_kept_are_refused_before_all_images_are_looked_at(
    room, truth, given, tmp_path
):
    given({name: np.diag([1.0, -1, -1, 1]) @ viewmat for name, viewmat in truth.items()})
    with raises(SfmError, "poses", "images") as caught:
        run_here(room, tmp_path / "out")
    assert "axes" in caught.value.hint
    assert database.keypoint_counts(tmp_path / "out" / "database.db") == {}


@pytest.mark.integration
def test_a_known_distance_scales_cameras_points_and_what_is_undistorted(
    room, truth, given, tmp_path
):
    given(truth, np.random.default_rng(0).normal(size=(50, 3)))
    first, last = "000000.png", "000016.png"
    summary = run_here(room, tmp_path / "out", scale_between=(first, "000016", 5.0))
    for folder in ("sparse", "undistorted/sparse"):
        centers = {name: np.linalg.inv(viewmat)[:3, 3] for name, _, viewmat in read_images(
            tmp_path / "out" / folder / "images.bin")}
        assert np.linalg.norm(centers[first] - centers[last]) == pytest.approx(5)
    plain = np.linalg.inv(truth[first])[:3, 3] - np.linalg.inv(truth[last])[:3, 3]
    similarity = summary.world.similarity
    assert similarity["scale"] == pytest.approx(5 / np.linalg.norm(plain))
    np.testing.assert_array_equal(similarity["rotation"], np.eye(3))  # others build on the axes
    written = json.loads((tmp_path / "out" / "world.json").read_text())
    assert summary.world.to_json() == written


def test_a_place_that_does_not_exist_is_told_before_anything_is_mapped(
    room, truth, given, tmp_path
):
    given(truth)
    with raises(ConfigError, "000017.png"):
        run_here(room, tmp_path / "out", scale_between=("000000.png", "000017.png", 5.0))
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.integration
def test_points_are_triangulated_from_poses_that_stay_where_they_are(room, truth, given, tmp_path):
    given({name: viewmat for name, viewmat in truth.items() if name != POSELESS})
    summary = run_here(room, tmp_path / "out")
    poses = found(tmp_path / "out")
    assert summary.unregistered == (POSELESS,)
    assert summary.poses == PosesSummary(use="keep", metric=True)
    for name, viewmat in poses.items():
        np.testing.assert_allclose(viewmat, truth[name], atol=1e-9)
    assert summary.points > 300
    assert coloured(tmp_path / "out")
    assert summary.reprojection_error_px < 1
    camera, = summary.cameras
    assert camera == {"width": 600, "height": 340, "focal_px": 300.0, "frames": COUNT - 1}


@pytest.mark.integration
def test_refined_poses_come_nearer_to_the_truth_and_keep_its_unit(room, truth, given, tmp_path):
    noise = np.random.default_rng(0)
    given({name: shaken(viewmat, noise) for name, viewmat in truth.items()})
    summary = run_here(room, tmp_path / "out", poses="refine")
    # Steps between frames do not depend on where the whole was moved to: they were given with an
    # error of 2 cm and more, over a path of some 2 m.
    np.testing.assert_allclose(steps(found(tmp_path / "out")), steps(truth), rtol=0.05)
    moved = summary.poses
    assert 0 < moved.moved_median < moved.moved_max < 0.1
    assert coloured(tmp_path / "out")
    assert summary.reprojection_error_px < moved.reprojection_error_px_before


def coloured(out):
    """Whether the points have the colours of the images, and not black."""
    return (read_points(out / "sparse" / "points3D.bin")[1].max(axis=1) > 10).mean() > 0.9


def steps(viewmats):
    """Distances from each camera to the next."""
    centers = [-viewmats[name][:3, :3].T @ viewmats[name][:3, 3] for name in sorted(viewmats)]
    return [np.linalg.norm(one - two) for one, two in itertools.pairwise(centers)]


def shaken(viewmat, noise):
    """A pose with errors of 1 cm an axis and 0.2 degrees an axis."""
    other = viewmat.copy()
    other[:3, :3] = Rotation.from_rotvec(
        noise.normal(scale=0.2, size=3), degrees=True).as_matrix() @ other[:3, :3]
    other[:3, 3] += noise.normal(scale=0.01, size=3)
    return other


@pytest.mark.integration
def test_poses_that_have_nothing_to_do_with_the_images_are_refused(room, truth, given, tmp_path):
    """Every camera looks backwards, as with the axes of another convention."""
    given({name: np.diag([1.0, -1, -1, 1]) @ viewmat for name, viewmat in truth.items()})
    with pytest.raises(SfmError) as caught:
        run_here(room, tmp_path / "out")
    assert_facts(caught.value.message, "images")
    assert "--poses ignore" in caught.value.hint


@pytest.mark.integration
def test_two_posed_frames_are_too_few(room, truth, given, tmp_path):
    given(dict(list(truth.items())[:2]))
    with raises(SfmError, 2, 9, "frames"):
        run_here(room, tmp_path / "out")


def test_frames_of_two_cameras_and_their_masks_are_undistorted_each_by_its_own(tmp_path):
    lenses = [
        Lens("OPENCV", 64, 48, (50.0, 50.0, 32.0, 24.0, -0.2, 0.02, 0.0, 0.0)),
        Lens("SIMPLE_RADIAL", 80, 60, (70.0, 40.0, 30.0, 0.1))]
    images = {f"{index}.png": texture(48, 64, index) for index in range(3)}
    base = write_inputs(tmp_path / "in", images)
    for stage in ("ingest", "denoise"):
        write_png(base / stage / "frames" / "2.png", texture(60, 80, 9))
    (base / "ingest" / "masks").mkdir()
    half = np.zeros((48, 64), np.uint8)
    half[:, 32:] = 255
    (base / "ingest" / "masks" / "1.png").write_bytes(cv2.imencode(".png", half)[1].tobytes())
    FrameList("nerfstudio", tuple(
        Group("camera", lens.width, lens.height, lens=lens) for lens in lenses), tuple(
        Frame(name, None, name, None, held_out=False, group=int(name == "2.png"),
              masked=name == "1.png") for name in images)).write(base / "ingest")
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 0, 3] = range(3)
    KnownPoses(dict(zip(images, viewmats, strict=True)), True, np.ones((4, 3)),
               np.zeros((4, 3), np.uint8)).write(base / "ingest")
    summary = run_here(base, tmp_path / "out")
    assert [camera["frames"] for camera in summary.cameras] == [2, 1]
    undistorted = tmp_path / "out" / "undistorted"
    for name, camera in (("1.png", 0), ("2.png", 1)):
        shape = read_png(undistorted / "images" / name).shape
        assert shape == (*(summary.cameras[camera][side] for side in ("height", "width")), 3)
    assert [path.name for path in (undistorted / "masks").iterdir()] == ["1.png"]
    mask = cv2.imread(str(undistorted / "masks" / "1.png"), cv2.IMREAD_UNCHANGED)
    assert mask.shape == read_png(undistorted / "images" / "1.png").shape[:2]
    assert set(np.unique(mask)) == {0, 255}
    middle = mask.shape[1] // 2
    assert not mask[:, :middle - 1].any()
    assert mask[:, middle + 1:].all()


@pytest.mark.integration
def test_tracked_poses_are_refined_and_give_metres_and_up(room, truth, given, tmp_path):
    noise = np.random.default_rng(0)
    given({name: shaken(viewmat, noise) for name, viewmat in truth.items()}, tracked=True)
    summary = run_here(room, tmp_path / "out")
    assert summary.poses.use == "auto"
    assert summary.poses.held == 0
    assert summary.world.evidence.metres
    assert summary.world.evidence.axis == "data set"
    np.testing.assert_allclose(steps(found(tmp_path / "out")), steps(truth), rtol=0.05)


@pytest.mark.integration
def test_tracked_poses_of_another_capture_are_not_used(room, truth, given, tmp_path):
    given({name: np.diag([1.0, -1, -1, 1]) @ viewmat for name, viewmat in truth.items()},
          tracked=True)
    summary = run_here(room, tmp_path / "out", min_registered=0.3)
    assert summary.poses.use == "refuted"
    assert not summary.world.evidence.metres
    assert_facts("\n".join(summary.lines), "pictures", "alone")
