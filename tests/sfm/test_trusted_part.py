"""What is delivered of models that are broken in a known place, and of several models."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from facts import raises
from made_model import MadeModel, along, broken_walk, doubled_place, moved, walk, wall

from recon_cli.errors import SfmError
from recon_cli.sfm.job import CameraGroup, MappingJob
from recon_cli.sfm.mapping import trusted_part
from recon_cli.sfm.mapping.mapper import list_registered
from recon_cli.sfm.mapping.merge_models import ModelCandidate, build_posed_model
from recon_cli.sfm.mapping.trusted_part import count_distinct_views, deliver_parts, find_parts
from recon_cli.sfm.verdict.verdict import examine


def prepare(made, folder, **changes):
    """Returns the job, and the model with the verdict on it."""
    made.write_database(folder / "database.db")
    job = MappingJob(
        frames=folder, out=folder, groups=(CameraGroup(made.names, 600, 400),),
        masks=None, poses=None, pose_use="keep", given_points=False, pairs="auto",
        max_features=2000, min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=5.0, seed=0, threads=1, sharpness={},
        times={name: float(index) for index, name in enumerate(made.names)})
    job, model = replace(job, **changes), made.model()
    return job, ModelCandidate(
        model, examine(model, job.database, job.names, times=job.times), (), {})


def cut(model, names):
    """A copy of a model with some images alone."""
    part = pycolmap.Reconstruction(model)
    for index in list(part.reg_image_ids()):
        if part.image(index).name not in names:
            part.deregister_frame(part.image(index).frame_id)
    return part


def held(parts):
    return [list_registered(part.model) for part in parts]


@pytest.fixture
def small(monkeypatch):
    """Parts of three frames are worth to be delivered."""
    monkeypatch.setattr(trusted_part, "FEWEST_FRAMES", 3)


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_of_a_broken_walk_both_sides_are_delivered_the_longer_first(tmp_path):
    made = broken_walk(at=10, count=2400)  # the few that tie both sides wrongly bend a part less
    job, whole = prepare(made, tmp_path)
    longer, shorter = deliver_parts(job, whole)
    assert held([longer, shorter]) == [list(made.names[:10]), list(made.names[10:])]
    assert longer.verdict.trusted
    assert shorter.verdict.trusted
    assert len(list_registered(whole.model)) == 16  # the model itself is left alone
    # The cameras of each part stand as in truth, up to the scale.
    for part, inside in ((longer, slice(10)), (shorter, slice(10, 16))):
        steps, truth = (np.linalg.norm(np.diff(centers, axis=0), axis=1) for centers in (
            [part.model.find_image_with_name(name).projection_center()
             for name in made.names[inside]],
            [pose.inverse().translation for pose in made.poses[inside]]))
        np.testing.assert_allclose(steps / steps.mean(), truth / truth.mean(), rtol=1e-3)


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_the_part_that_shows_most_comes_before_one_of_more_frames(tmp_path):
    waiting, walking = np.arange(10) * 0.06, 30 + np.arange(7) * 1.6
    made = MadeModel(np.concatenate([wall(-4, 5, count=900), wall(26, 44, count=1800)]),
                     along([*waiting, *walking]))
    job, whole = prepare(made, tmp_path)
    there, onward = cut(whole.model, made.names[:10]), cut(whole.model, made.names[10:])
    assert count_distinct_views(there) < 1.5 < count_distinct_views(onward)
    whole = replace(whole, model=there, verdict=examine(
        there, job.database, job.names, times=job.times))
    assert held(deliver_parts(job, whole, [onward])) == [made.names[10:], made.names[:10]]


@pytest.mark.integration
def test_a_part_of_few_frames_is_delivered_only_as_the_largest(tmp_path):
    made = broken_walk(at=10)
    job, whole = prepare(made, tmp_path)
    assert held(deliver_parts(job, whole)) == [list(made.names[:10])]


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_two_places_laid_over_each_other_are_two_parts(tmp_path):
    made = doubled_place()
    job, whole = prepare(made, tmp_path)
    assert sorted(held(deliver_parts(job, whole))) == [made.names[:6], made.names[6:]]


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_other_models_of_the_mapper_are_parts_without_what_a_larger_one_holds(tmp_path):
    made = walk()
    job, whole = prepare(made, tmp_path)
    first, other, few = (cut(whole.model, made.names[start:end])
                         for start, end in ((0, 9), (7, 16), (13, 16)))
    whole = replace(whole, model=first, verdict=examine(first, job.database, job.names))
    assert held(deliver_parts(job, whole, [few, other])) == [made.names[:9], made.names[9:]]


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_another_model_is_cut_where_it_is_broken(tmp_path):
    made = broken_walk(at=10)
    job, whole = prepare(made, tmp_path)
    first, other = cut(whole.model, made.names[:3]), cut(whole.model, made.names[3:])
    whole = replace(whole, model=first, verdict=examine(first, job.database, job.names))
    assert held(find_parts(job, whole, [other])) == [
        made.names[3:10], made.names[10:], made.names[:3]]


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_a_model_without_points_gets_those_that_the_matches_give(tmp_path):
    made = walk()
    job, whole = prepare(made, tmp_path)
    first = cut(whole.model, made.names[:9])
    whole = replace(whole, model=first, verdict=examine(first, job.database, job.names))
    other = build_posed_model(job.database, None, dict(zip(
        made.names[9:], made.poses[9:], strict=True)))
    assert not other.num_points3D()
    _, part = find_parts(job, whole, [other])
    assert held([part]) == [made.names[9:]]
    assert part.model.num_points3D() > 500


@pytest.mark.integration
def test_parts_that_are_too_small_together_are_refused_with_their_size(tmp_path):
    job, whole = prepare(broken_walk(at=10), tmp_path, min_registered=0.7)
    with raises(SfmError, 10, 16, "000000", "together") as refused:
        deliver_parts(job, whole)
    assert "--min-registered" in refused.value.hint


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_parts_count_together(tmp_path):
    job, whole = prepare(broken_walk(at=10), tmp_path, min_registered=0.7)
    assert len(deliver_parts(job, whole)) == 2


@pytest.mark.integration
def test_a_broken_model_that_shall_not_be_cut_is_refused(tmp_path):
    job, whole = prepare(broken_walk(at=10), tmp_path, partial=False)
    with raises(SfmError, "broken"):
        deliver_parts(job, whole)


@pytest.mark.integration
@pytest.mark.parametrize("changes", [{"partial": False}, {"accept_weak": True}])
def test_a_model_that_shall_stay_whole_is_not_cut(tmp_path, changes):
    made = broken_walk(at=10) if "accept_weak" in changes else walk()
    job, whole = prepare(made, tmp_path, **changes)
    part, = deliver_parts(job, whole, [whole.model])
    assert part is whole


@pytest.mark.integration
def test_a_sound_model_is_not_cut(tmp_path):
    job, whole = prepare(walk(), tmp_path)
    assert deliver_parts(job, whole) == [whole]


@pytest.mark.integration
@pytest.mark.usefixtures("small")
def test_a_model_broken_twice_is_cut_twice(tmp_path):
    made = walk(
        motions={**dict.fromkeys(range(3, 11), moved(1, 2, 0, degrees=20)),
                 **dict.fromkeys(range(11, 16), moved(-2, 3, 1, degrees=-20))},
        landmark=lambda image, point: (
            point if point < 60 else ((image >= 3) + (image >= 11), point)))
    job, whole = prepare(made, tmp_path)
    assert held(find_parts(job, whole)) == [
        made.names[3:11], made.names[11:], made.names[:3]]
