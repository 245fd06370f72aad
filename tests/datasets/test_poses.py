import numpy as np
import pytest
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.workspace.records import POINTS, POSES, KnownPoses, read_poses

POSE = np.array([[0, -1, 0, 0.1], [1, 0, 0, 1 / 3], [0, 0, 1, 2], [0, 0, 0, 1.0]])


def test_poses_and_points_come_back_as_they_were_written(tmp_path):
    points, colors = np.arange(12).reshape(4, 3) / 7, np.arange(12, dtype=np.uint8).reshape(4, 3)
    KnownPoses({"a.png": POSE}, True, points, colors).write(tmp_path)
    back = read_poses(tmp_path / POSES)
    assert back.metric
    np.testing.assert_array_equal(back.viewmats["a.png"], POSE)
    np.testing.assert_array_equal(back.points, points)
    np.testing.assert_array_equal(back.colors, colors)


def test_poses_may_come_without_points(tmp_path):
    KnownPoses({"a.png": POSE}, False).write(tmp_path)
    back = read_poses(tmp_path / POSES)
    assert (back.metric, back.points, back.colors) == (False, None, None)
    assert not (tmp_path / POINTS).exists()


@pytest.mark.parametrize("spoil", ["missing", "cut"])
def test_points_that_are_gone_or_cut_off_are_refused(tmp_path, spoil):
    KnownPoses({"a.png": POSE}, True, np.zeros((9, 3)), np.zeros((9, 3), np.uint8)).write(tmp_path)
    if spoil == "missing":
        (tmp_path / POINTS).unlink()
    else:
        (tmp_path / POINTS).write_bytes((tmp_path / POINTS).read_bytes()[:-1])
    with raises(FormatError, "poses.json"):
        read_poses(tmp_path / POSES)
