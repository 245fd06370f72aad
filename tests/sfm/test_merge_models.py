"""Models that are merged, and wrong images that are taken out."""

from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from synthetic import center_error, make_capture, moved, part

from recon_cli.sfm.mapping import mapper, merge_models
from recon_cli.sfm.verdict.weakest_cut import OutlierCamera

# Features are exact to float32 (1e-4 px of 1000), the path is 9 units wide.
EXACT = 1e-4


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture"))


@pytest.mark.parametrize("first", [10, 12], ids=["two images in both", "no image in both"])
def test_two_parts_of_a_capture_become_one(capture, first):
    job, truth = capture
    base = part(truth, job.names[:12])
    other = part(truth, job.names[first:], motion=moved())
    joined = merge_models.merge(job, base, other)
    assert mapper.list_registered(joined) == list(job.names)
    assert center_error(joined, truth) < EXACT
    assert joined.compute_mean_reprojection_error() < 0.01


def test_the_similarity_between_two_parts_is_found_from_their_points(capture):
    job, truth = capture
    found = merge_models.find_similarity(
        job, part(truth, job.names[12:], motion=moved()), part(truth, job.names[:12]))
    np.testing.assert_allclose(
        found.matrix[:3], moved().inverse().matrix(), atol=1e-6)


@pytest.mark.integration
def test_a_join_counts_both_ways_only_where_three_images_of_each_agree_on_the_scale(
    capture, monkeypatch
):
    job, truth = capture
    base, other = part(truth, job.names[:12]), part(truth, job.names[12:], motion=moved())
    scale = 1 / moved().scale
    assert merge_models._shows_scale(job, other, base, scale)
    assert not merge_models._shows_scale(job, other, base, 1.1 * scale)
    assert not merge_models._shows_scale(job, part(truth, job.names[18:]), base, 1.0)
    joined = merge_models.merge(job, base, other, both_ways=True)
    assert mapper.list_registered(joined) == list(job.names)
    one_way = merge_models._shows_scale
    monkeypatch.setattr(merge_models, "_shows_scale", lambda job, source, target, scale: (
        source is other and one_way(job, source, target, scale)))
    assert merge_models.merge(job, base, other, both_ways=True) is None
    assert merge_models.merge(job, base, other) is not None


def test_a_part_that_brings_less_than_three_images_is_left_alone(capture):
    job, truth = capture
    assert merge_models.merge(
        job, part(truth, job.names[:18]), part(truth, job.names[10:])) is None


def test_a_posed_model_holds_the_images_of_the_database_and_no_points(capture):
    job, truth = capture
    poses = {image.name: image.cam_from_world()
             for image in map(truth.image, truth.reg_image_ids()) if image.name in job.names[:5]}
    model = merge_models.build_posed_model(job.database, None, poses)
    assert mapper.list_registered(model) == list(job.names[:5])
    assert model.num_points3D() == 0


@dataclass(frozen=True)
class Opinion:
    """As much of a verdict as is looked at."""

    trusted: bool = True
    outliers: tuple[OutlierCamera, ...] = ()


@pytest.fixture
def fresh_capture(tmp_path):
    return make_capture(tmp_path)


def say(monkeypatch, opinion):
    monkeypatch.setattr(merge_models.verdict, "examine", lambda model, *_, **__: opinion(model))


def test_nothing_comes_of_no_model(fresh_capture):
    job, _ = fresh_capture
    assert merge_models.best_model(job, []) is None


@pytest.mark.integration
def test_parts_that_fit_become_one_model_and_nothing_is_apart(fresh_capture):
    job, truth = fresh_capture
    found = merge_models.best_model(job, [
        part(truth, job.names[12:], motion=moved()), part(truth, job.names[:12])])
    assert mapper.list_registered(found.model) == list(job.names)
    assert found.apart == ()
    assert center_error(found.model, truth) < 1e-3


@pytest.mark.integration
def test_parts_that_cannot_be_put_together_are_named(fresh_capture, monkeypatch):
    job, truth = fresh_capture
    monkeypatch.setattr(merge_models, "find_similarity", lambda *_: None)
    found = merge_models.best_model(job, [
        part(truth, job.names[12:16]), part(truth, job.names[:12]), part(truth, job.names[10:13]),
        part(truth, job.names[14:])])
    assert mapper.list_registered(found.model) == list(job.names[:12])
    assert found.apart == (job.names[14:],)  # 12 and 13 are fewer than three


@pytest.mark.integration
def test_a_merge_that_cannot_be_trusted_is_undone(fresh_capture, monkeypatch):
    job, truth = fresh_capture
    say(monkeypatch, lambda model: Opinion(trusted=model.num_reg_images() < 20))
    found = merge_models.best_model(job, [part(truth, job.names[:12]), part(truth, job.names[12:])])
    assert mapper.list_registered(found.model) == list(job.names[:12])
    assert found.apart == (job.names[12:],)


@pytest.mark.integration
def test_a_camera_that_was_put_elsewhere_is_found_taken_out_and_named(fresh_capture):
    job, truth = fresh_capture
    wrong = job.names[7]
    model = astray(truth, wrong)
    found = merge_models.best_model(job, [model])
    assert mapper.list_registered(found.model) == sorted(set(job.names) - {wrong})
    assert list(found.rejected) == [wrong]
    assert found.rejected[wrong]
    assert center_error(found.model, truth) < 1e-3
    assert found.verdict.trusted


def astray(truth, name):
    """The true model with one camera turned and moved away; points that it saw are not its own."""
    model = pycolmap.Reconstruction(truth)
    image = model.find_image_with_name(name)
    for row, point in enumerate(image.points2D):
        if point.has_point3D():
            model.delete_observation(image.image_id, row)
    turn = pycolmap.Rotation3d(np.array([0, np.sin(0.2), 0, np.cos(0.2)]))
    model.frame(image.frame_id).set_cam_from_world(
        image.camera_id,
        pycolmap.Rigid3d(turn, np.array([0.5, 1.0, 0.3])) * image.cam_from_world())
    return model


def test_where_many_cameras_are_suspected_the_model_is_left_as_it_is(fresh_capture, monkeypatch):
    job, truth = fresh_capture
    suspects = tuple(OutlierCamera(name, 0.1, 200, "", None) for name in job.names[:5])
    say(monkeypatch, lambda _: Opinion(trusted=False, outliers=suspects))
    found = merge_models.best_model(job, [pycolmap.Reconstruction(truth)])
    assert found.model.num_reg_images() == 20
    assert found.rejected == {}
    assert not found.verdict.trusted
