import cv2
import numpy as np
import pytest

from recon_cli.io.calibration import undistort_pixels
from recon_cli.scene.camera import MODELS, Lens

K = np.array([[400.0, 0, 320.5], [0, 410, 240.25], [0, 0, 1]])
INNER = (400.0, 410.0, 320.5, 240.25)
GRID = np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.5, 0.5, 9))
RAYS = np.stack(GRID, axis=-1).reshape(-1, 2)
SPACE = np.column_stack([RAYS, np.ones(len(RAYS))])


def test_a_pinhole_is_undone_in_closed_form():
    pixels = np.array([[320.5, 240.25], [720.5, 445.25]])
    np.testing.assert_array_equal(
        undistort_pixels(Lens("PINHOLE", 640, 480, INNER), pixels), [[0, 0], [1, 0.5]])


@pytest.mark.parametrize(("model", "coefficients"), [
    ("OPENCV", (-0.28, 0.1, 0.001, -0.002)),
    ("FULL_OPENCV", (-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001))])
def test_perspective_distortion_is_undone(model, coefficients):
    pixels = cv2.projectPoints(SPACE, np.zeros(3), np.zeros(3), K, np.array(coefficients))[0][:, 0]
    lens = Lens(model, 640, 480, (*INNER, *coefficients))
    np.testing.assert_allclose(undistort_pixels(lens, pixels), RAYS, atol=1e-12)


def test_models_with_one_focal_length_are_undone():
    square = np.array([[400.0, 0, 320.5], [0, 400, 240.25], [0, 0, 1]])
    for model, coefficients in (("SIMPLE_RADIAL", (0.1,)), ("RADIAL", (0.1, -0.05))):
        padded = np.array([*coefficients, 0, 0, 0, 0])[:5] * [1, len(coefficients) > 1, 0, 0, 0]
        pixels = cv2.projectPoints(SPACE, np.zeros(3), np.zeros(3), square, padded)[0][:, 0]
        lens = Lens(model, 640, 480, (400.0, 320.5, 240.25, *coefficients))
        np.testing.assert_allclose(undistort_pixels(lens, pixels), RAYS, atol=1e-12)


@pytest.mark.parametrize(("model", "coefficients"), [
    ("OPENCV_FISHEYE", (0.03, -0.01, 0.002, -0.001)),
    ("RADIAL_FISHEYE", (0.03, -0.01)), ("SIMPLE_RADIAL_FISHEYE", (0.03,))])
def test_a_fisheye_is_undone(model, coefficients):
    k = [*coefficients, 0.0, 0.0, 0.0][:4]
    theta = np.arctan(np.linalg.norm(RAYS, axis=1))
    bent = theta * (1 + sum(c * theta ** (2 * at + 2) for at, c in enumerate(k)))
    scale = np.divide(bent, np.tan(theta), out=np.ones_like(bent), where=theta > 0)
    focals = (400.0, 410.0) if model == "OPENCV_FISHEYE" else (400.0,)
    pixels = RAYS * scale[:, None] * [focals[0], focals[-1]] + [320.5, 240.25]
    lens = Lens(model, 640, 480, (*focals, 320.5, 240.25, *coefficients))
    np.testing.assert_allclose(undistort_pixels(lens, pixels), RAYS, atol=1e-7)


def test_every_model_of_colmap_is_known_and_undone_or_said_to_have_no_direction():
    pycolmap = pytest.importorskip("pycolmap")
    pixels = np.stack(np.meshgrid([140.0, 320, 500], [90.0, 240, 390]), axis=-1).reshape(-1, 2)
    for name, number in pycolmap.CameraModelId.__members__.items():
        if name in ("INVALID", "EQUIRECTANGULAR"):
            continue
        camera = pycolmap.Camera.create_from_model_id(1, number, 400.0, 640, 480)
        focals, count = MODELS[name]
        assert (len(camera.focal_length_idxs()), len(camera.params)) == (focals, count), name
        assert list(camera.principal_point_idxs()) == [focals, focals + 1], name
        rays = undistort_pixels(Lens(name, 640, 480, tuple(camera.params)), pixels)
        again = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        np.testing.assert_allclose(again, pixels, atol=0.01)


def test_a_pixel_whose_direction_is_not_found_has_none():
    """The corner of a fisheye that shows 193 degrees from corner to corner."""
    lens = Lens("OPENCV_FISHEYE", 960, 720, (340, 343, 486, 356, 0.03, -0.006, 0.001, -0.0001))
    rays = undistort_pixels(lens, np.array([[1.0, 1.0], [486.0, 356.0], [826.0, 356.0]]))
    assert np.isnan(rays[0]).all()
    np.testing.assert_array_equal(rays[1], [0, 0])
    assert rays[2][0] == pytest.approx(1.45, abs=0.1)  # 340 px, a radian less the distortion


def test_no_pixels_have_no_rays():
    assert undistort_pixels(Lens("PINHOLE", 4, 4, (1.0,) * 4), np.zeros((0, 2))).shape == (0, 2)
