"""What is kept of models that are broken in a known place."""

from dataclasses import replace

import numpy as np
import pytest
from made_model import broken_walk, doubled_place, moved, walk

from recon_cli.errors import SfmError
from recon_cli.sfm.job import CameraGroup, MappingJob
from recon_cli.sfm.mapper import list_registered
from recon_cli.sfm.trusted_part import find_trusted_part, keep_trusted_part
from recon_cli.sfm.verdict import examine


def prepare(made, folder, **changes):
    """Returns the job, the model and the verdict on it."""
    made.write_database(folder / "database.db")
    job = MappingJob(
        frames=folder, denoised=folder, out=folder, groups=(CameraGroup(made.names, 600, 400),),
        masks=None, poses=None, pose_use="keep", given_points=False, pairs="auto",
        max_features=2000, min_registered=0.5, accept_weak=False, partial=True, gravity=True,
        scale_between=None, max_minutes=5.0, seed=0, threads=1, sharpness={}, times={})
    job, model = replace(job, **changes), made.model()
    return job, model, examine(model, job.database, job.names)


def test_of_a_broken_walk_the_longer_side_is_kept(tmp_path):
    made = broken_walk(at=10)
    job, model, verdict = prepare(made, tmp_path)
    part = keep_trusted_part(job, model, verdict)
    assert part is not None
    assert list_registered(part.candidate.model) == list(made.names[:10])
    assert part.candidate.verdict.trusted
    assert part.left_out == tuple(made.names[10:])
    for fact in ("broken", "10 of 16 frames"):
        assert fact in part.sentence
    assert len(list_registered(model)) == 16  # the model itself is left alone
    # The cameras of the part stand as in truth, up to the scale.
    steps, truth = (np.linalg.norm(np.diff(centers, axis=0), axis=1) for centers in (
        [part.candidate.model.find_image_with_name(name).projection_center()
         for name in made.names[:10]],
        [pose.inverse().translation for pose in made.poses[:10]]))
    np.testing.assert_allclose(steps / steps.mean(), truth / truth.mean(), rtol=1e-3)


def test_of_two_places_laid_over_each_other_one_is_kept(tmp_path):
    made = doubled_place()
    job, model, verdict = prepare(made, tmp_path)
    part = keep_trusted_part(job, model, verdict)
    assert part is not None
    assert set(list_registered(part.candidate.model)) in (
        set(made.names[:6]), set(made.names[6:]))


def test_a_part_that_is_too_small_is_refused_with_its_size(tmp_path):
    job, model, verdict = prepare(broken_walk(at=10), tmp_path, min_registered=0.7)
    with pytest.raises(SfmError, match="has 10 of 16 frames") as refused:
        keep_trusted_part(job, model, verdict)
    assert "--min-registered" in refused.value.hint


@pytest.mark.parametrize("changes", [{"partial": False}, {"accept_weak": True}])
def test_a_model_that_shall_stay_whole_is_not_cut(tmp_path, changes):
    job, model, verdict = prepare(broken_walk(at=10), tmp_path, **changes)
    assert keep_trusted_part(job, model, verdict) is None


def test_a_sound_model_is_not_cut(tmp_path):
    job, model, verdict = prepare(walk(), tmp_path)
    assert keep_trusted_part(job, model, verdict) is None


def test_a_model_broken_twice_is_cut_twice(tmp_path):
    made = walk(
        motions={**dict.fromkeys(range(3, 11), moved(1, 2, 0, degrees=20)),
                 **dict.fromkeys(range(11, 16), moved(-2, 3, 1, degrees=-20))},
        landmark=lambda image, point: (
            point if point < 60 else ((image >= 3) + (image >= 11), point)))
    job, model, verdict = prepare(made, tmp_path)
    part = find_trusted_part(job, model, verdict)
    assert part is not None
    assert list_registered(part.model) == list(made.names[3:11])
