import archive_splats
import numpy as np
from facts import raises

from recon_cli.errors import InputError
from recon_cli.scene.splats import SH_C0
from recon_cli.splats.ply import read_ply_points, write_points

SPLATS = {
    "means": [[1, 2, 3], [4, 5, 6], [-7, 8.5, 1e6]], "quats": np.ones((3, 4)),
    "log_scales": np.zeros((3, 3)), "logit_opacities": [0.0, -0.01, 50],
    "sh_dc": (np.array([[0, 0.5, 1], [1, 1, 1], [0.2, -3, 7]]) - 0.5) / SH_C0,
    "sh_rest": np.ones((3, 3, 3))}


def test_opaque_gaussians_become_points_of_their_plain_colour(tmp_path):
    write_points(tmp_path / "a.ply", archive_splats.splats_of(**SPLATS))
    points, colors = read_ply_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, [[1, 2, 3], [-7, 8.5, 1e6]])
    np.testing.assert_array_equal(colors, [[0, 128, 255], [51, 0, 255]])


def test_the_layout_is_what_other_programs_expect(tmp_path):
    write_points(tmp_path / "a.ply", archive_splats.splats_of(**SPLATS))
    head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert head.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "element vertex 2",
        "property float x", "property float y", "property float z",
        "property uchar red", "property uchar green", "property uchar blue"]
    assert data[:15] == np.array([1, 2, 3], "<f4").tobytes() + bytes([0, 128, 255])
    assert len(data) == 30


def test_a_scene_that_is_all_haze_has_no_points(tmp_path):
    splats = archive_splats.splats_of(**{**SPLATS, "logit_opacities": [-3.0, -3, -3]})
    with raises(InputError, 3, "Gaussians"):
        write_points(tmp_path / "a.ply", splats)
    assert list(tmp_path.iterdir()) == []
