from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon_cli.capture.camera_groups import group_notices, group_photos, odd_photos
from recon_cli.capture.images import Photo


def photo(name, width=64, height=48, *, focal=None, camera="", mm=None):
    return Photo(Path(name), width, height, focal, camera, mm)


def sorted_out(*photos):
    return [[one.path.name for one in group.photos] for group in group_photos(photos)]


def test_photos_of_one_size_without_exif_are_one_group_of_which_nothing_is_said():
    groups = group_photos([photo("a"), photo("b")])
    assert [group.name for group in groups] == ["64x48"]
    assert group_notices(groups) == []


def test_sizes_and_orientations_are_groups_of_their_own_in_the_order_of_their_first_photos():
    found = sorted_out(photo("a"), photo("b", 48, 64), photo("c"), photo("d", 80, 60), photo("e"))
    assert found == [["a", "c", "e"], ["b"], ["d"]]


@pytest.mark.parametrize("other", [
    photo("b", camera="Two", focal=50.0),
    photo("b", camera="One", focal=50.6),
    photo("b", camera="One"),
    photo("b", camera="One", focal=50.0, mm=4.4),
])
def test_another_camera_or_focal_length_is_another_group(other):
    assert sorted_out(photo("a", camera="One", focal=50.0), other) == [["a"], ["b"]]


def test_focal_lengths_within_a_percent_are_one_setting():
    assert sorted_out(photo("a", focal=100.0, mm=4.3), photo("b", focal=100.9, mm=4.33)) == [
        ["a", "b"]]


def test_groups_are_named_by_what_tells_them_apart():
    groups = group_photos([
        photo("a", camera="One", mm=24.0), photo("b", camera="One", mm=70.0),
        photo("c", 48, 64, camera="One", mm=24.0), photo("d"), photo("e", focal=90.0)])
    assert [group.name for group in groups] == [
        "One 64x48 24 mm", "One 64x48 70 mm", "One 48x64", "64x48", "64x48 f = 90 px"]
    assert group_notices(groups) == [
        "The photos are of 5 kinds, each with a lens of its own: 1 of One 64x48 24 mm, "
        "1 of One 64x48 70 mm, 1 of One 48x64, 1 of 64x48, 1 of 64x48 f = 90 px."]


def test_a_picture_that_fits_no_other_is_named():
    groups = group_photos([photo("a"), photo("b"), photo("logo.png", 100, 20)])
    assert [one.path.name for one in odd_photos(groups)] == ["logo.png"]
    assert "logo.png fits no other photo: 100x20 and no EXIF" in group_notices(groups)[1]


@pytest.mark.parametrize("single", [
    photo("b", 100, 20, camera="One"), photo("b", 100, 20, mm=4.3), photo("b")])
def test_what_has_exif_or_the_size_of_others_is_not_odd(single):
    assert odd_photos(group_photos([photo("a"), photo("c", camera="Two"), single])) == []


@given(st.lists(st.tuples(st.sampled_from([48, 64]), st.sampled_from(["", "One"])), max_size=8))
def test_every_photo_is_in_one_group_and_names_differ(kinds):
    photos = [photo(str(k), width, camera=camera) for k, (width, camera) in enumerate(kinds)]
    groups = group_photos(photos)
    assert sorted(str(p.path) for g in groups for p in g.photos) == sorted(
        str(p.path) for p in photos)
    assert len({group.name for group in groups}) == len(groups)
