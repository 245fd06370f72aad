import io

import numpy as np
import pycolmap
import pytest
from synthetic import center_error, make_capture, part

from recon_cli.sfm.job import Reporter
from recon_cli.sfm.mapping import mapper, merge_models
from recon_cli.sfm.mapping.mapper import triangulation_angles

pytestmark = pytest.mark.floors


def test_the_angle_of_a_point_is_that_of_its_widest_pair_of_rays():
    """Cameras at x = 0, 1 and 2 see points one unit before the first: 0, 45 and 63.4 degrees."""
    model = pycolmap.Reconstruction()
    assert triangulation_angles(model).shape == (0,)
    model.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=8, height=6, params=[5, 5, 4, 3]))
    seen_by = [(0, 1, 2), (0, 1), (1, 2), (2, 1, 0)]
    for x in range(3):
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                image_id=x + 1, name=f"{x}.png", camera_id=1,
                points2D=[pycolmap.Point2D(np.zeros(2)) for _ in seen_by]),
            pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-float(x), 0, 0])))
    widest = float(np.degrees(np.arctan(2)))
    expected = {}
    for row, places in enumerate(seen_by):
        track = pycolmap.Track()
        for x in places:
            track.add_element(x + 1, row)
        number = model.add_point3D(np.array([0.0, 0, 1]), track)
        expected[number] = [widest, 45, widest - 45, widest][row]
    found = dict(zip(model.points3D, triangulation_angles(model).tolist(), strict=True))
    assert found == pytest.approx(expected)


def shifted(model, camera):
    """Moves the principal point of a camera by 5 pixels; the second two are cx and cy."""
    model.camera(camera).params = model.camera(camera).params + np.array([0, 0, 5, 0, 0, 0, 0, 0])


def test_the_last_adjustment_finds_the_principal_point(tmp_path):
    _, truth = make_capture(tmp_path)
    model = pycolmap.Reconstruction(truth)
    shifted(model, 1)
    mapper.adjust(model)
    assert model.camera(1).params[2] == pytest.approx(512, abs=0.1)
    assert center_error(model, truth) < 1e-3


def test_a_camera_with_few_images_keeps_its_intrinsics_beside_one_with_many(tmp_path):
    job, truth = make_capture(tmp_path, frames=12, cameras=2)
    few = sorted(name for name in job.names if "camera000002" in name)[3:]
    assert len(few) == 9
    model = part(truth, set(job.names).difference(few))
    before = model.camera(2).params.copy()
    shifted(model, 1)
    mapper.adjust(model)
    assert model.camera(1).params[2] == pytest.approx(512, abs=0.1)
    np.testing.assert_array_equal(model.camera(2).params, before)


def test_known_intrinsics_stay_as_they_are(tmp_path):
    _, truth = make_capture(tmp_path)
    model = pycolmap.Reconstruction(truth)
    mapper.adjust(model, constant={1})
    np.testing.assert_array_equal(model.camera(1).params, truth.camera(1).params)


@pytest.mark.integration
def test_the_global_mapper_finds_the_cameras_and_leaves_the_database_alone(tmp_path):
    job, truth = make_capture(tmp_path)
    before = job.database.read_bytes()
    model, = mapper.map_globally(job, Reporter(io.BytesIO()))
    assert model.num_reg_images() == 20
    assert center_error(model, truth) < 1e-2
    assert job.database.read_bytes() == before
    assert list(job.attempts.iterdir()) == []


def test_a_model_is_extended_by_the_images_that_fit(tmp_path):
    job, truth = make_capture(tmp_path)
    whole = mapper.extend_model(job, part(truth, job.names[:15]))
    assert mapper.list_registered(whole) == list(job.names)
    assert center_error(whole, truth) < 1e-3


def test_a_model_is_extended_without_adjusting_the_whole_again(tmp_path):
    job, truth = make_capture(tmp_path)
    whole = mapper.extend_model(job, part(truth, job.names[:15]), rounds=0)
    assert mapper.list_registered(whole) == list(job.names)
    assert center_error(whole, truth) < 1e-2


def test_images_are_placed_by_the_points_of_a_model_that_stays_as_it_is(tmp_path):
    job, truth = make_capture(tmp_path)
    held = job.names[:15]
    model = merge_models.build_posed_model(
        job.database, truth, {name: truth.find_image_with_name(name).cam_from_world()
                              for name in held})  # the others are not in it
    model = mapper.triangulate(job, model, rounds=1)
    before = {name: model.find_image_with_name(name).cam_from_world().matrix() for name in held}
    assert mapper.resect(job, model) == 5
    assert mapper.list_registered(model) == list(job.names)
    assert center_error(model, truth) < 1e-2
    for name in held:
        np.testing.assert_array_equal(
            model.find_image_with_name(name).cam_from_world().matrix(), before[name])


def test_triangulated_points_leave_the_cameras_where_they_are(tmp_path):
    job, truth = make_capture(tmp_path)
    bare = pycolmap.Reconstruction(truth)
    for number in list(bare.point3D_ids()):
        bare.delete_point3D(number)
    model = mapper.triangulate(job, bare, rounds=1)
    assert model.num_points3D() > 0.9 * truth.num_points3D()
    assert model.compute_mean_reprojection_error() < 0.01
    for number in truth.reg_image_ids():
        np.testing.assert_allclose(model.image(number).cam_from_world().matrix(),
                                   truth.image(number).cam_from_world().matrix(), atol=1e-12)


def test_a_point_that_the_adjustment_lost_is_dropped(tmp_path, monkeypatch):
    _, model = make_capture(tmp_path)
    before, lost = model.num_points3D(), min(model.point3D_ids())

    def lose(model, _):
        model.point3D(lost).xyz = np.array([1e100, 0, 0])

    monkeypatch.setattr(pycolmap, "bundle_adjustment", lose)
    mapper.adjust(model)
    assert model.num_points3D() == before - 1
    assert model.compute_mean_reprojection_error() < 1


def disturb(model, pixels, *, share, seed=0):
    """Moves a share of the observations of each image to the right, and adjusts the model."""
    generator = np.random.default_rng(seed)
    for number in model.reg_image_ids():
        for point in model.image(number).points2D:
            noise = generator.normal(0, 0.05, 2)
            wrong = generator.uniform() < share
            point.xy = point.xy + noise + (np.array([pixels, 0]) if wrong else 0)
    mapper.adjust(model)


def test_observations_that_are_off_no_longer_bend_a_model(tmp_path):
    _, truth = make_capture(tmp_path)
    model = pycolmap.Reconstruction(truth)
    disturb(model, 3.0, share=0.05)
    observations = model.compute_num_observations()
    sharp = mapper.sharpen(model)
    assert center_error(sharp, truth) < 0.5 * center_error(model, truth)
    assert 0.93 * observations < sharp.compute_num_observations() < 0.97 * observations
    assert sharp.num_reg_images() == 20
    assert model.compute_num_observations() == observations


def test_an_image_keeps_its_points_where_most_would_be_lost(tmp_path):
    _, truth = make_capture(tmp_path)
    model = pycolmap.Reconstruction(truth)
    number = min(model.reg_image_ids())
    for index, point in enumerate(model.image(number).points2D):
        if index % 3:
            point.xy = point.xy + np.array([0, 3.0 if index % 2 else -3.0])
    sharp = mapper.sharpen(model)
    assert sharp.image(number).num_points3D > 0.9 * model.image(number).num_points3D
    assert center_error(sharp, truth) < center_error(model, truth) + 1e-3


def test_points_are_refined_until_the_cameras_settle(tmp_path):
    job, truth = make_capture(tmp_path)
    model = pycolmap.Reconstruction(truth)
    generator = np.random.default_rng(0)
    for point in model.points3D.values():
        point.xyz = point.xyz + generator.normal(0, 0.02, 3)
    shifted(model, 1)
    mapper.refine(job, model)
    assert center_error(model, truth) < 1e-3
    assert model.camera(1).params[2] == pytest.approx(512, abs=0.1)
    assert model.compute_mean_reprojection_error() < 0.01
