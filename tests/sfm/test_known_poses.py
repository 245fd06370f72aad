import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon_cli.sfm.poses.known_poses import align_to_given, measure_movement, near_pairs


def cameras(centers, turn=0.0):
    """[F, 4, 4] world to camera at some centres, turned about y by `turn` degrees."""
    matrices = np.tile(np.eye(4), (len(centers), 1, 1))
    matrices[:, :3, :3] = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    matrices[:, :3, 3] = -np.einsum("fij,fj->fi", matrices[:, :3, :3], np.asarray(centers, float))
    return matrices


def line(count):
    return [(x, 0.0, 0.0) for x in range(count)]


def test_each_camera_is_paired_with_the_nearest():
    viewmats = dict(zip([f"{i:02d}" for i in range(40)], cameras(line(40)), strict=True))
    found = near_pairs(viewmats)
    assert ("00", "20") in found  # twenty neighbours on the one side that there is
    assert ("00", "21") not in found
    assert ("15", "25") in found  # ten on either side
    assert all(one < two for one, two in found)


def test_cameras_that_look_apart_are_not_paired():
    viewmats = {
        "a": cameras([(0, 0, 0)])[0], "b": cameras([(0.1, 0, 0)], turn=90)[0],
        "c": cameras([(5, 0, 0)], turn=60)[0]}
    assert near_pairs(viewmats) == {("a", "c"), ("b", "c")}


def test_what_was_moved_as_a_whole_is_brought_back_even_from_a_line():
    """Centres on a line leave the turn about it open; the rotations of the cameras do not."""
    given = cameras(line(5), turn=20)
    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
    whole[:3, 3] = (3, -2, 1)
    found = given @ np.linalg.inv(whole)
    found[:, :3, 3] *= 0.5  # a unit twice as long
    motion = align_to_given(found, given)
    assert motion.scale == pytest.approx(2)
    centers = -np.einsum("fji,fj->fi", found[:, :3, :3], found[:, :3, 3])
    matrix = motion.matrix()
    np.testing.assert_allclose(centers @ matrix[:, :3].T + matrix[:, 3], line(5), atol=1e-9)


def test_movement_is_a_share_of_the_path_and_degrees():
    given, found = cameras(line(5)), cameras(line(5))
    found[2] = cameras([(2, 0.4, 0)], turn=3)[0]
    moved = measure_movement(found, given)
    assert moved["moved_median"] == 0
    assert moved["moved_max"] == pytest.approx(0.1)  # 0.4 of a path 4 long
    assert moved["turned_max_deg"] == pytest.approx(3)
