"""How well each camera of a photo model is known."""

from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from made_model import MadeModel, moved
from scipy.spatial.transform import Rotation

from recon_cli.sfm.verdict.camera_covariance import (
    MAX_MODEL_ERROR,
    SHARED_ERRORS,
    describe_inexact,
    estimate_camera_errors,
    list_loose,
    list_rough,
    measure_rms,
)
from recon_cli.sfm.verdict.verdict import examine

NOISE_PX = 0.5
MANY = defaultdict(lambda: 100)  # points that a camera sees


def converging(count=6, points=100):
    """Cameras that look at a cloud of points from 60 degrees, each rolled and tilted by its own."""
    generator = np.random.default_rng(5)
    places = generator.uniform([-1.5, -1.2, 4.0], [1.5, 1.2, 6.0], (points, 3))
    poses = []
    for yaw in np.linspace(-30, 30, count):
        turn = Rotation.from_euler(
            "yxz", [yaw, *generator.uniform(-25, 25, 2)], degrees=True).as_matrix()
        poses.append(pycolmap.Rigid3d(
            pycolmap.Rotation3d(turn), [0, 0, 5] - turn @ [0, 0, 5]))
    return MadeModel(places, poses)


def noisy(made, seed):
    """Returns its model with noise on all pixels, not adjusted to them."""
    generator = np.random.default_rng(seed)
    for index in range(len(made.poses)):
        numbers, places = made._project(index)
        made._views[index] = numbers, places + generator.normal(0, NOISE_PX, places.shape)
    return made.model()


def adjust(model):
    """Returns a model adjusted by least squares until nothing moves."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = True, False
    options.ceres.solver_options.function_tolerance = 1e-9
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    return model


def centers(model, names):
    return np.array([model.find_image_with_name(name).projection_center() for name in names])


def off_after_similarity(found, true):
    """[F, 3] (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    return np.trace(np.diag(s) @ flip) / (a**2).sum() * a @ (u @ flip @ vt).T - b


@pytest.mark.integration
def test_errors_are_the_spread_of_adjustments_to_noisy_pixels():
    made = converging()
    true = np.array([pose.inverse().translation for pose in made.poses])
    extent = np.linalg.norm(np.ptp(true, axis=0))
    runs = [adjust(noisy(made, seed)) for seed in range(40)]
    off = np.array([off_after_similarity(centers(model, made.names), true) for model in runs])
    spread = np.sqrt((off**2).sum(axis=2).mean(axis=0)) / extent
    expected = np.array([
        list(estimate_camera_errors(model, made.names).values()) for model in runs[:3]
    ]).mean(axis=0) / SHARED_ERRORS
    # 40 runs give a spread to 8%; a robust loss sees a fifth less of normal noise than squares do
    assert (expected / spread).mean() == pytest.approx(0.8, abs=0.2)
    np.testing.assert_allclose(expected, spread, rtol=0.45)


def test_the_frame_and_the_scale_of_a_model_change_no_error():
    made = converging()
    model = adjust(noisy(made, 0))
    errors = estimate_camera_errors(model, made.names)
    model.transform(pycolmap.Sim3d(7.0, moved(0, 0, 0, degrees=50).rotation, [100.0, -20, 3]))
    assert estimate_camera_errors(model, made.names) == pytest.approx(errors, rel=0.03)


def with_one_far_off():
    """Twelve photos, and one from further away that shares five points with them."""
    made = converging(count=12)
    made.poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(), [1.0, 0, 3]))
    made.hidden[12] = made._project(12)[0][5:]
    return made


def test_photos_of_much_in_common_are_not_rough_and_one_that_shares_few_points_is():
    made = converging()
    errors = estimate_camera_errors(noisy(made, 0), made.names)
    assert not list_rough(errors, MANY)
    assert not list(describe_inexact(errors))
    made = with_one_far_off()
    errors = estimate_camera_errors(noisy(made, 0), made.names)
    assert list_rough(errors, MANY) == (made.names[12],)
    assert not list(describe_inexact(errors)), "one rough camera is no reason against the others"


def test_a_camera_that_few_points_place_is_rough_however_well_it_fits():
    errors = {"a.png": 0.001, "b.png": 0.001, "c.png": 0.021}
    assert list_rough(errors, {"a.png": 30, "b.png": 29, "c.png": 300}) == ("b.png", "c.png")


def test_a_camera_that_few_points_place_must_explain_its_matches():
    names = ("few.png", "many.png", "right.png", "walk.png")
    pairs = np.array([[0, 1], [0, 2], [1, 2], [1, 3]])
    evidence = SimpleNamespace(
        names=names, pairs=pairs, placed=np.full(4, True), points=np.array([22, 300, 29, 5]),
        matches=np.array([100, 20, 200, 80]), explained=np.array([55, 20, 190, 10]))
    errors = dict.fromkeys(names[:3], 0.001)  # a walk's camera has none
    assert [(each.name, each.matches) for each in list_loose(errors, evidence)] == [
        ("few.png", 120)]
    assert not list(list_loose({}, evidence))


def test_an_error_is_a_share_of_the_extent_even_where_nothing_tells_it():
    made = converging(count=3, points=6)
    model = noisy(made, 0)
    assert max(estimate_camera_errors(model, made.names).values()) <= 1
    for point in list(model.points3D)[1:]:
        model.delete_point3D(point)
    errors = estimate_camera_errors(model, made.names)
    assert measure_rms(errors) > MAX_MODEL_ERROR


@pytest.mark.parametrize(("times", "judged"), [({}, True), ({"all": True}, False)])
def test_photos_that_few_points_tie_are_not_trusted_by_their_errors(tmp_path, times, judged):
    made = converging(points=7)
    model = noisy(made, 0)
    verdict = examine(model, made.write_database(tmp_path / "database.db"), made.names, times={
        name: float(index) for index, name in enumerate(made.names)} if times else {})
    assert bool(verdict.camera_errors) == judged
    assert (measure_rms(verdict.camera_errors) > MAX_MODEL_ERROR) == judged
    assert set(describe_inexact(verdict.camera_errors)) <= set(verdict.problems)
    assert verdict.to_json()["rough"] == list(verdict.rough)
    assert any("rough" in line for line in verdict.lines()) == judged
    assert bool(verdict.rough) == judged
