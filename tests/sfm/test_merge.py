import numpy as np
import pytest
from synthetic import center_error, make_capture, moved, part

from recon_cli.sfm import mapper, merge_models

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
    joined = merge_models.added(job, base, other)
    assert mapper.names(joined) == list(job.names)
    assert center_error(joined, truth) < EXACT
    assert joined.compute_mean_reprojection_error() < 0.01


def test_the_similarity_between_two_parts_is_found_from_their_points(capture):
    job, truth = capture
    base = part(truth, job.names[:12])
    shared = merge_models.shared_points(
        job.database, part(truth, job.names[12:], motion=moved()), base)
    assert len(shared.source) == 300
    found = merge_models.similarity(shared, base, seed=0)
    np.testing.assert_allclose(found.matrix(), moved().inverse().matrix(), atol=1e-6)


def test_points_that_contradict_each_other_give_no_similarity(capture):
    _, truth = capture
    noise = np.random.default_rng(0)
    shared = merge_models.Shared(noise.normal(size=(200, 3)), noise.normal(size=(200, 3)))
    assert merge_models.similarity(shared, truth, seed=0) is None


def test_too_few_shared_points_give_no_similarity(capture):
    _, truth = capture
    few = np.random.default_rng(0).normal(size=(merge_models.MIN_INLIERS - 1, 3))
    assert merge_models.similarity(merge_models.Shared(few, few), truth, seed=0) is None


def test_a_part_that_brings_less_than_three_images_is_left_alone(capture):
    job, truth = capture
    assert merge_models.added(
        job, part(truth, job.names[:18]), part(truth, job.names[10:])) is None


def test_a_posed_model_holds_the_images_of_the_database_and_no_points(capture):
    job, truth = capture
    poses = {image.name: image.cam_from_world()
             for image in map(truth.image, truth.reg_image_ids()) if image.name in job.names[:5]}
    model = merge_models.posed(job.database, None, poses)
    assert mapper.names(model) == list(job.names[:5])
    assert model.num_points3D() == 0
