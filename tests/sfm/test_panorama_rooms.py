"""Panoramas of several rooms: another mapper is tried for a room that is left out."""

from dataclasses import replace

import pycolmap
from facts import assert_facts, raises
from panoramas import make_panoramas

from recon_cli.errors import SfmError
from recon_cli.sfm.features import matching
from recon_cli.sfm.limits import MIN_FRAMES, MIN_PANORAMA_SHARE
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.mapping.fallbacks import describe_other_rooms, list_fallbacks
from recon_cli.sfm.mapping.merge_models import ModelCandidate
from recon_cli.sfm.mapping.trusted_part import deliver_parts, frames_asked, least_frames
from recon_cli.sfm.verdict.verdict import examine


def test_a_room_that_matches_itself_alone_is_worth_another_mapper(tmp_path):
    job, model = make_panoramas(tmp_path)
    first, second = job.names[:8], job.names[8:]
    part = pycolmap.Reconstruction(model)
    for name in second:
        part.deregister_frame(part.find_image_with_name(name).frame_id)
    verdict = replace(examine(part, job.database, job.names), match_parts=(first, second))
    candidate = ModelCandidate(part, verdict, (), {})
    assert_facts(describe_other_rooms(job, candidate), 4, "panoramas", "match")
    assert describe_other_rooms(job, replace(candidate, apart=(second,))) == ""
    pair = replace(verdict, match_parts=(job.names[:10], job.names[10:]))
    assert describe_other_rooms(job, replace(candidate, verdict=pair)) == ""
    photos = replace(job, groups=(replace(job.groups[0], lens=None),))
    assert describe_other_rooms(photos, candidate) == ""


def test_three_panoramas_are_a_part(tmp_path):
    job, _ = make_panoramas(tmp_path, frames=4, points=40)
    assert least_frames(job) == MIN_FRAMES
    assert least_frames(replace(job, groups=(replace(job.groups[0], lens=None),))) > MIN_FRAMES


def rooms(tmp_path, *parts, **changes):
    """Returns a job, and a true model of the first part, of panoramas that match in these parts."""
    job, model = make_panoramas(tmp_path)
    for name in set(job.names).difference(parts[0]):
        model.deregister_frame(model.find_image_with_name(name).frame_id)
    verdict = replace(examine(model, job.database, job.names), match_parts=parts)
    assert verdict.trusted
    return replace(job, **changes), ModelCandidate(model, verdict, (), {})


def test_panoramas_that_match_no_two_others_do_not_count_against_a_room(tmp_path):
    names = make_panoramas(tmp_path / "a")[0].names
    alone = [(name,) for name in names[6:]]
    job, room = rooms(tmp_path / "b", names[:4], names[4:6], *alone, min_registered=0.5)
    assert frames_asked(job, room.verdict) == names[:4]
    part, = deliver_parts(job, room)
    assert part.model.num_reg_images() == 4
    photos = replace(job, groups=(replace(job.groups[0], lens=None),))
    assert frames_asked(photos, room.verdict) == names


def test_a_room_whose_panoramas_should_have_been_placed_counts(tmp_path):
    names = make_panoramas(tmp_path / "a")[0].names
    job, room = rooms(tmp_path / "b", names[:4], names[4:11], names[11:], min_registered=0.5)
    with raises(SfmError, 4, 11) as refused:
        deliver_parts(job, room)
    assert "--min-registered" in refused.value.hint
    assert len(deliver_parts(replace(job, min_registered=0.3), room)) == 1


def test_many_panoramas_are_matched_as_they_look_alike_and_not_by_a_skeleton(tmp_path):
    job, _ = make_panoramas(tmp_path, frames=3, points=40)
    group = job.groups[0]
    many = replace(job, groups=(replace(group, names=tuple(f"{k}.png" for k in range(40))),))
    assert [way.name for way in list_fallbacks(many)] == ["exhaustive", "relaxed", "global"]


def test_panoramas_are_mapped_by_points_that_two_of_them_see(tmp_path):
    job, _ = make_panoramas(tmp_path, frames=6, points=40)
    options = mapper._options(job)
    assert not options.triangulation.ignore_two_view_tracks
    assert matching._verification_options(job).min_inlier_ratio == MIN_PANORAMA_SHARE
    photos = replace(job, groups=(replace(job.groups[0], lens=None),))
    assert mapper._options(photos).triangulation.ignore_two_view_tracks
    assert matching._verification_options(photos).min_inlier_ratio != MIN_PANORAMA_SHARE
