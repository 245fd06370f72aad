import numpy as np
import pytest
from facts import raises
from hypothesis import given
from hypothesis import strategies as st

from recon_cli.errors import FormatError
from recon_cli.io.calibration import lens_from_matrix, viewmat_from_pose
from recon_cli.scene.camera import make_lens

POSE = np.array([[0, 0, 1, 2], [1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 0, 1.0]])


def test_a_pose_is_inverted():
    np.testing.assert_allclose(viewmat_from_pose(POSE, "it") @ POSE, np.eye(4), atol=1e-15)


def test_a_camera_beyond_all_coordinates_is_refused():
    far = POSE.copy()
    far[0, 3] = 1e30
    with raises(FormatError, "1e+30", 3, 4):
        viewmat_from_pose(far, "it")


def test_a_pose_may_be_a_row_of_numbers_or_lack_its_last_row():
    expected = viewmat_from_pose(POSE, "it")
    np.testing.assert_array_equal(viewmat_from_pose(POSE.ravel().tolist(), "it"), expected)
    np.testing.assert_array_equal(viewmat_from_pose(POSE[:3].tolist(), "it"), expected)


def test_what_an_opengl_camera_has_behind_and_above_lies_ahead_and_below_in_ours():
    viewmat = viewmat_from_pose(np.eye(4), "it", opengl=True)
    np.testing.assert_array_equal(viewmat @ [1, 2, -3, 1], [1, -2, 3, 1])


def test_a_rounded_rotation_is_made_orthonormal():
    turned = POSE.copy()
    turned[:3, :3] = np.round(turn(0.3), 3)
    rotation = viewmat_from_pose(turned, "it")[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation, turn(0.3).T, atol=6e-4)


@given(angle=st.floats(-3, 3), scale=st.sampled_from([0.5, 0.99, 1.01, 3.0]))
def test_a_scaled_pose_is_refused_with_its_scale(angle, scale):
    scaled = np.eye(4)
    scaled[:3, :3] = scale * turn(angle)
    with raises(FormatError, 7, f"{scale:.4g}", "scaled"):
        viewmat_from_pose(scaled, "frame 7")


def test_a_reflection_and_a_shear_are_refused():
    with raises(FormatError, "reflection"):
        viewmat_from_pose(np.diag([1.0, 1, -1, 1]), "it")
    sheared = np.eye(4)
    sheared[0, 1] = 0.1
    with raises(FormatError, "right", "angles"):
        viewmat_from_pose(sheared, "it")


@pytest.mark.parametrize(("value", "fact"), [
    (np.full((4, 4), np.nan), "finite"), (np.eye(3), 9), ("abc", "matrix"),
    ([[1, 2], [3]], "matrix"), (None, "numbers"), (np.zeros((4, 4)), "row"),
    (np.diag([0.0, 0, 0, 1]), "rigid")])
def test_what_is_no_pose_is_refused(value, fact):
    with raises(FormatError, "it", fact):
        viewmat_from_pose(value, "it")


def test_a_matrix_with_pixel_centres_at_whole_numbers_is_moved_by_half_a_pixel():
    K = np.array([[300.0, 0, 299.5], [0, 310, 169.5], [0, 0, 1]])
    assert lens_from_matrix(K, 600, 340, "K").params == (300, 310, 300, 170)


def test_a_skewed_matrix_is_refused():
    with raises(FormatError, "skew"):
        lens_from_matrix(
            np.array([[300.0, 9, 299.5], [0, 310, 169.5], [0, 0, 1]]), 600, 340, "K")


@pytest.mark.parametrize(("model", "size", "params", "facts"), [
    ("PINHOLE", (4, 4), (1, 1, 2), [4, 3]),
    ("LENS", (4, 4), (1, 1, 2, 2, 0), ["LENS"]),
    ("PINHOLE", (4, 4), (1, float("nan"), 2, 2), ["finite"]),
    ("PINHOLE", (4, 4), (1, 0, 2, 2), ["camera"]),
    ("PINHOLE", (0, 4), (1, 1, 2, 2), ["camera"]),
    ("PINHOLE", (1e9, 4), (1, 1, 2, 2), ["camera"])])
def test_what_is_no_lens_is_refused(model, size, params, facts):
    with raises(FormatError, "camera 1", *facts):
        make_lens(model, *size, params, "camera 1")


def turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
