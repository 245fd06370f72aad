from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from synthetic import center_error, make_capture, moved, part

from recon_cli.sfm import mapper, merge_models, model_selection
from recon_cli.sfm.weakest_cut import Astray


@dataclass(frozen=True)
class Opinion:
    """As much of a verdict as is looked at."""

    trusted: bool = True
    astray: tuple[Astray, ...] = ()


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path)


def say(monkeypatch, opinion):
    monkeypatch.setattr(model_selection.verdict, "examine", lambda model, *_, **__: opinion(model))


def test_nothing_comes_of_no_model(capture):
    job, _ = capture
    assert model_selection.best(job, []) is None


def test_parts_that_fit_become_one_model_and_nothing_is_apart(capture):
    job, truth = capture
    found = model_selection.best(job, [
        part(truth, job.names[12:], motion=moved()), part(truth, job.names[:12])])
    assert mapper.names(found.model) == list(job.names)
    assert found.apart == ()
    assert center_error(found.model, truth) < 1e-3


def test_parts_that_cannot_be_put_together_are_named(capture, monkeypatch):
    job, truth = capture
    monkeypatch.setattr(merge_models, "similarity", lambda *_, **__: None)
    found = model_selection.best(job, [
        part(truth, job.names[12:16]), part(truth, job.names[:12]), part(truth, job.names[10:13]),
        part(truth, job.names[14:])])
    assert mapper.names(found.model) == list(job.names[:12])
    assert found.apart == (job.names[14:],)  # 12 and 13 are fewer than three


def test_a_merge_that_cannot_be_trusted_is_undone(capture, monkeypatch):
    job, truth = capture
    say(monkeypatch, lambda model: Opinion(trusted=model.num_reg_images() < 20))
    found = model_selection.best(job, [part(truth, job.names[:12]), part(truth, job.names[12:])])
    assert mapper.names(found.model) == list(job.names[:12])
    assert found.apart == (job.names[12:],)


def test_a_camera_that_was_put_elsewhere_is_found_taken_out_and_named(capture):
    job, truth = capture
    wrong = job.names[7]
    model = astray(truth, wrong)
    found = model_selection.best(job, [model])
    assert mapper.names(found.model) == sorted(set(job.names) - {wrong})
    assert list(found.rejected) == [wrong]
    assert "of its" in found.rejected[wrong]
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


def test_where_many_cameras_are_suspected_the_model_is_left_as_it_is(capture, monkeypatch):
    job, truth = capture
    suspects = tuple(Astray(name, 0.1, 200) for name in job.names[:5])
    say(monkeypatch, lambda _: Opinion(trusted=False, astray=suspects))
    found = model_selection.best(job, [pycolmap.Reconstruction(truth)])
    assert found.model.num_reg_images() == 20
    assert found.rejected == {}
    assert not found.verdict.trusted
