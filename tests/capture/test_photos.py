"""Folders of photos, frame names and groups of one camera."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from recon_cli.capture.images import Photo
from recon_cli.capture.photos import (
    check_count,
    group_notices,
    group_photos,
    list_photos,
    make_frame_names,
    odd_photos,
    photo_folder,
)
from recon_cli.errors import InputError


def photo(name, width=64, height=48, focal=None):
    return Photo(Path(name), width, height, focal)


def test_photos_are_told_from_other_files_by_content(tmp_path):
    for name in ("b.jpg", "a.jpg", "no_suffix.png"):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / name)
    (tmp_path / "no_suffix.png").rename(tmp_path / "no_suffix")
    (tmp_path / ".hidden.jpg").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("not a photo")
    (tmp_path / "broken.JPG").write_bytes(b"not a photo either")
    (tmp_path / "IMG_1.HEIC").write_bytes(b"cannot be read here")
    (tmp_path / "more").mkdir()
    folder = list_photos(tmp_path.iterdir())
    assert [found.path.name for found in folder.photos] == ["a.jpg", "b.jpg", "no_suffix"]
    assert sorted(folder.broken) == ["IMG_1.HEIC", "broken.JPG"]
    assert "broken.JPG cannot be read" in folder.broken["broken.JPG"]


def test_photos_are_listed_as_a_person_counts(tmp_path):
    for name in ("IMG_10.png", "IMG_9.png", "IMG_100.png"):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / name)
    names = [found.path.name for found in list_photos(tmp_path.iterdir()).photos]
    assert names == ["IMG_9.png", "IMG_10.png", "IMG_100.png"]


def test_plain_names_are_kept():
    assert make_frame_names(["IMG_0001", "IMG_0002", "a.b-c"]) == [
        "IMG_0001.png", "IMG_0002.png", "a.b-c.png"]


@pytest.mark.parametrize("stems", [
    ["a", "a", "b"],  # one stem twice
    ["A", "a", "b"],  # one file twice where case does not count
    ["a b", "c", "d"],
    ["Küche", "c", "d"],
    ["IMG_9", "IMG_10", "IMG_11"],  # would sort in another order
])
def test_other_names_are_numbered(stems):
    assert make_frame_names(stems) == [
        "000000.png", "000001.png", "000002.png"]


def test_too_few_photos_are_refused_with_the_reason():
    check_count(Path("room"), 3, {})
    with pytest.raises(InputError, match="room holds 1 photo, but at least 3"):
        check_count(Path("room"), 1, {})
    with pytest.raises(InputError, match=r"no photos that can.* 2 that.*a\.jpg cannot be read"):
        check_count(Path("room"), 0, {"a.jpg": "a.jpg cannot be read.", "b.jpg": "?"})


def small(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8)).save(path)


def test_a_folder_with_photos_is_taken_itself(tmp_path):
    small(tmp_path / "a.png")
    small(tmp_path / "images" / "b.png")
    assert photo_folder(tmp_path) == tmp_path


def test_the_one_folder_with_photos_inside_is_taken(tmp_path):
    small(tmp_path / "DCIM" / "a.png")
    small(tmp_path / "masks" / "a.png")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("none")
    assert photo_folder(tmp_path) == tmp_path / "DCIM"


def test_among_several_inner_folders_the_one_called_images_is_taken(tmp_path):
    for name in ("images", "images_2", "renders"):
        small(tmp_path / name / "a.png")
    assert photo_folder(tmp_path) == tmp_path / "images"
    (tmp_path / "images").rename(tmp_path / "other")
    with pytest.raises(InputError, match="3 of its subfolders do: images_2, other") as caught:
        photo_folder(tmp_path)
    assert "images_2" in caught.value.hint


def test_a_folder_of_broken_photos_is_not_left_for_another(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    small(tmp_path / "thumbnails" / "a.png")
    assert photo_folder(tmp_path) == tmp_path


def shot(name, width=64, height=48, *, focal=None, camera="", mm=None):
    return Photo(Path(name), width, height, focal, camera, mm)


def sorted_out(*photos):
    return [[one.path.name for one in group.photos] for group in group_photos(photos)]


def test_photos_of_one_size_without_exif_are_one_group_of_which_nothing_is_said():
    groups = group_photos([shot("a"), shot("b")])
    assert [group.name for group in groups] == ["64x48"]
    assert group_notices(groups) == []


def test_sizes_and_orientations_are_groups_of_their_own_in_the_order_of_their_first_photos():
    found = sorted_out(shot("a"), shot("b", 48, 64), shot("c"), shot("d", 80, 60), shot("e"))
    assert found == [["a", "c", "e"], ["b"], ["d"]]


@pytest.mark.parametrize("other", [
    shot("b", camera="Two", focal=50.0),
    shot("b", camera="One", focal=50.6),
    shot("b", camera="One"),
    shot("b", camera="One", focal=50.0, mm=4.4),
])
def test_another_camera_or_focal_length_is_another_group(other):
    assert sorted_out(shot("a", camera="One", focal=50.0), other) == [["a"], ["b"]]


def test_focal_lengths_within_a_percent_are_one_setting():
    assert sorted_out(shot("a", focal=100.0, mm=4.3), shot("b", focal=100.9, mm=4.33)) == [
        ["a", "b"]]


def test_groups_are_named_by_what_tells_them_apart():
    groups = group_photos([
        shot("a", camera="One", mm=24.0), shot("b", camera="One", mm=70.0),
        shot("c", 48, 64, camera="One", mm=24.0), shot("d"), shot("e", focal=90.0)])
    assert [group.name for group in groups] == [
        "One 64x48 24 mm", "One 64x48 70 mm", "One 48x64", "64x48", "64x48 f = 90 px"]
    assert group_notices(groups) == [
        "The photos form 5 groups with separate intrinsics: 1 of One 64x48 24 mm, "
        "1 of One 64x48 70 mm, 1 of One 48x64, 1 of 64x48, 1 of 64x48 f = 90 px."]


def test_a_picture_that_fits_no_other_is_named():
    groups = group_photos([shot("a"), shot("b"), shot("logo.png", 100, 20)])
    assert [one.path.name for one in odd_photos(groups)] == ["logo.png"]
    assert "logo.png matches no other photo: 100x20, no EXIF" in group_notices(groups)[1]


@pytest.mark.parametrize("single", [
    shot("b", 100, 20, camera="One"), shot("b", 100, 20, mm=4.3), shot("b")])
def test_what_has_exif_or_the_size_of_others_is_not_odd(single):
    assert odd_photos(group_photos([shot("a"), shot("c", camera="Two"), single])) == []


@given(st.lists(st.tuples(st.sampled_from([48, 64]), st.sampled_from(["", "One"])), max_size=8))
def test_every_photo_is_in_one_group_and_names_differ(kinds):
    photos = [shot(str(k), width, camera=camera) for k, (width, camera) in enumerate(kinds)]
    groups = group_photos(photos)
    assert sorted(str(p.path) for g in groups for p in g.photos) == sorted(
        str(p.path) for p in photos)
    assert len({group.name for group in groups}) == len(groups)
