"""7-Scenes and TUM RGB-D: small sequences whose poses and depth are known in closed form."""

import numpy as np
import posed_sets
import pytest
from facts import assert_facts, raises

from recon_cli.datasets.kinect import read_seven_scenes, read_tum
from recon_cli.errors import FormatError, InputError


def test_poses_are_inverted_and_lost_frames_left_out(tmp_path):
    posed = read_seven_scenes(posed_sets.make_seven_scenes(tmp_path, frames=5, lost=(1, 3)))
    assert [image.name for image in posed.images] == [
        f"frame-{number:06d}.color.png" for number in (0, 2, 4)]
    np.testing.assert_allclose(
        posed.images[1].viewmat @ posed_sets.pose(2), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(posed.lenses[0].params, (30.0, 30.0, 16.5, 11.0))
    assert_facts(posed.notices[0], 2, "frames", "tracking")
    assert (posed.metric, posed.sequence) == (True, True)


def test_depth_is_in_millimetres_and_unknown_where_it_is_65535(tmp_path):
    depth = read_seven_scenes(posed_sets.make_seven_scenes(tmp_path)).images[0].depth()
    assert (depth[:2, :3] == 0).all()
    expected = posed_sets.plane_depth(posed_sets.pose(0))
    np.testing.assert_allclose(depth[2:, 3:], expected[2:, 3:], atol=0.0006)


def test_numbers_may_have_any_count_of_digits(tmp_path):
    folder = posed_sets.make_seven_scenes(tmp_path)
    for path in list(folder.glob("frame-*")):
        path.rename(folder / path.name.replace("frame-0000", "frame-"))
    posed = read_seven_scenes(folder)
    assert [image.name for image in posed.images] == [
        "frame-00.color.png", "frame-02.color.png", "frame-03.color.png"]
    assert all(image.depth is not None for image in posed.images)


def test_intrinsics_may_lie_one_level_up(tmp_path):
    folder = posed_sets.make_seven_scenes(tmp_path / "seq-01")
    (folder / "camera-intrinsics.txt").rename(tmp_path / "camera-intrinsics.txt")
    assert read_seven_scenes(folder).lenses[0].params == (30.0, 30.0, 16.5, 11.0)


def test_without_intrinsics_a_kinect_is_assumed_at_its_size_alone(tmp_path):
    folder = posed_sets.make_seven_scenes(tmp_path)
    (folder / "camera-intrinsics.txt").unlink()
    with raises(FormatError, "32x24") as refused:
        read_seven_scenes(folder)
    assert "camera-intrinsics.txt" in refused.value.hint
    for path in folder.glob("*.color.png"):
        posed_sets.write_image(path, 640, 480)
    posed = read_seven_scenes(folder)
    assert posed.lenses[0].params == (525.0, 525.0, 320.0, 240.0)
    assert any("525" in notice for notice in posed.notices)
    # Depth of a wider lens, looked up along the rays of the colours, leaves their border empty.
    assert posed.images[0].depth().shape == (480, 640)


def test_a_sequence_that_was_lost_throughout_is_refused(tmp_path):
    with raises(InputError, 4, "tracking"):
        read_seven_scenes(posed_sets.make_seven_scenes(tmp_path, lost=range(4)))


def test_a_damaged_pose_is_named(tmp_path):
    folder = posed_sets.make_seven_scenes(tmp_path)
    (folder / "frame-000002.pose.txt").write_text("1 2 three")
    with raises(FormatError, "frame-000002.pose.txt"):
        read_seven_scenes(folder)


def test_tum_poses_are_interpolated_between_those_of_motion_capture(tmp_path):
    posed = read_tum(posed_sets.make_tum(tmp_path))
    assert [image.name for image in posed.images] == ["0.png", "1.png", "2.png"]
    for number, image in enumerate(posed.images):  # none lies at the time of a pose
        np.testing.assert_allclose(
            image.viewmat @ posed_sets.pose(number), np.eye(4), atol=1e-6)
    assert_facts(posed.notices[0], 1, "frame", "tracking")


def test_tum_depth_is_the_nearest_in_time(tmp_path):
    posed = read_tum(posed_sets.make_tum(tmp_path))
    expected = posed_sets.plane_depth(posed_sets.pose(1), 640, 480, 525.0, 320.0, 240.0)
    np.testing.assert_allclose(posed.images[1].depth(), expected, atol=1.1e-4)


def test_depth_at_another_time_is_left_out(tmp_path):
    folder = posed_sets.make_tum(tmp_path)
    (folder / "depth.txt").write_text("10.03 depth/0.png\n")
    assert all(image.depth is None for image in read_tum(folder).images)


@pytest.mark.parametrize(("name", "focal"), [
    ("rgbd_dataset_freiburg1_desk", 517.3), ("fr2_xyz", 520.9), ("freiburg3_long", 535.4),
    ("mine", 525.0)])
def test_the_camera_is_known_by_the_name_of_the_folder(tmp_path, name, focal):
    posed = read_tum(posed_sets.make_tum(tmp_path / name))
    assert posed.lenses[0].params[0] == focal
    assert posed.lenses[0].params[2] % 1 == pytest.approx({517.3: 0.1, 520.9: 0.6, 535.4: 0.6,
                                                           525.0: 0.0}[focal])
    assert any("525" in notice for notice in posed.notices) == (name == "mine")


def test_a_gap_of_motion_capture_gives_no_pose(tmp_path):
    folder = posed_sets.make_tum(tmp_path)
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    kept = [line for line in lines if line[0] == "#" or not 10.05 < float(line.split()[0]) < 10.16]
    (folder / "groundtruth.txt").write_text("\n".join(kept))
    assert [image.name for image in read_tum(folder).images] == ["0.png", "2.png"]


def write_path(folder, times, places):
    """Writes groundtruth.txt with the poses of some places of the walk."""
    lines = []
    for time, place in zip(times, places, strict=True):
        half = 0.05 * place / 2  # as in `posed_sets.pose`
        lines.append(f"{time:.4f} {0.1 * place} 0.05 -0.2 0 {np.sin(half)} 0 {np.cos(half)}\n")
    (folder / "groundtruth.txt").write_text("".join(lines))


@pytest.mark.parametrize("apart", [2.0, 0.5, 0.1, 0.03])
def test_a_pose_of_a_frames_own_time_counts_however_far_others_are(tmp_path, apart):
    folder = posed_sets.make_tum(tmp_path, frames=5)
    times = 1e9 + apart * np.arange(5)
    (folder / "rgb.txt").write_text("".join(
        f"{time:.6f} rgb/{n}.png\n" for n, time in enumerate(times)))
    (folder / "depth.txt").unlink()
    write_path(folder, times + 0.0004, range(5))  # as rounded elsewhere
    posed = read_tum(folder)
    assert len(posed.images) == 5
    for number, image in enumerate(posed.images):
        np.testing.assert_allclose(
            image.viewmat @ posed_sets.pose(number), np.eye(4), atol=1e-6)


@pytest.mark.integration
@pytest.mark.parametrize(("interval", "count"), [(0.02, 9), (0.1, 9), (0.2, 9), (1.0, 4)])
def test_between_poses_the_usual_interval_tells_a_gap(tmp_path, interval, count):
    """Frames lie in the middle between poses; five intervals of them are missing before the 5th.

    Over a second a hand moves too freely to be interpolated: one frame a pose is left.
    """
    folder = posed_sets.make_tum(tmp_path, frames=10)
    (folder / "depth.txt").unlink()
    steps = np.arange(10.0)
    steps[5:] += 12
    frames = (steps[:-1] + 0.5)
    frames[4] = steps[4] + 6
    frames = np.append(frames, steps[-1])
    if interval == 1.0:
        frames[:3] = steps[:3]
    (folder / "rgb.txt").write_text("".join(
        f"{10 + interval * step:.6f} rgb/{n}.png\n" for n, step in enumerate(frames)))
    write_path(folder, 10 + interval * steps, steps)
    posed = read_tum(folder)
    assert len(posed.images) == count
    assert "4.png" not in [image.name for image in posed.images]
    assert_facts("\n".join(posed.notices), "left", 10 - count)
