"""Folders of photos, frame names and groups of one camera."""

from pathlib import Path

import numpy as np
import pytest
from facts import assert_facts, raises
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from recon_cli.capture.images import Photo
from recon_cli.capture.photos import (
    PhotoFolder,
    check_count,
    choose_pictures,
    group_notices,
    group_photos,
    list_photos,
    make_frame_names,
    odd_photos,
)
from recon_cli.errors import InputError

pytestmark = pytest.mark.floors


def choose(folder, photos):
    """Returns the chosen ones of the photos of a folder, and the notices."""
    chosen, notices = choose_pictures(folder, PhotoFolder(tuple(photos), {}), "auto")
    return chosen.photos, notices


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
    assert_facts(folder.broken["broken.JPG"], "broken.JPG")


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
    check_count(Path("room"), [photo("a"), photo("b"), photo("c")], {})
    with raises(InputError, 1, 3, "photo"):
        check_count(Path("room"), [photo("a")], {})
    with raises(InputError, 2, "a.jpg"):
        check_count(Path("room"), [], {"a.jpg": "a.jpg cannot be read.", "b.jpg": "?"})


def test_photos_in_folders_are_called_by_their_paths_and_come_after_the_others(tmp_path):
    for name in ("b.png", "2/a.png", "10/a.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    (tmp_path / "2" / "c.jpg").touch()
    folder = list_photos(tmp_path.rglob("*"), tmp_path)
    assert [found.name for found in folder.photos] == ["b.png", "2/a.png", "10/a.png"]
    assert list(folder.broken) == ["2/c.jpg"]


def pictures(folder, **kinds):
    """Writes four pictures of each kind, by the first letters of their names."""
    folder.mkdir(exist_ok=True)
    gray = np.random.default_rng(0).integers(0, 65536, (6, 8)).astype(np.uint16)  # a photo
    values = {"I;16": gray, "depth": np.full((6, 8), 1500, np.uint16),
              "L": np.full((6, 8), 200, np.uint8),
              "RGB": np.full((6, 8, 3), 90, np.uint8)}
    for name, mode in kinds.items():
        for index in range(4):
            Image.fromarray(values[mode]).save(folder / f"{name}_{index}.png")
    return list_photos(folder.iterdir()).photos


def names(photos):
    return sorted({photo.name.rsplit("_", 1)[0] for photo in photos})


def test_depth_maps_and_masks_among_photos_are_left_out_and_named(tmp_path):
    photos, notices = choose(tmp_path, pictures(
        tmp_path, frame="RGB", z="I;16", IMG_mask="L", conf="L"))
    assert names(photos) == ["frame"]
    for notice, kind in zip(notices, ("confidence", "depth", "masks"), strict=True):
        assert_facts(notice, 4, kind)


@pytest.mark.parametrize("mode", ["I;16", "L"])
def test_photos_without_colours_are_photos(tmp_path, mode):
    listed = pictures(tmp_path / "room", a=mode)
    assert choose(tmp_path / "room", listed) == (listed, [])


def test_many_gray_photos_are_not_thrown_away_for_a_coloured_one(tmp_path):
    listed = pictures(tmp_path, a="I;16")
    Image.new("RGB", (8, 6)).save(tmp_path / "logo.png")
    (logo,) = list_photos([tmp_path / "logo.png"]).photos
    assert choose(tmp_path, [*listed, logo]) == ((*listed, logo), [])


def test_a_folder_of_depth_maps_holds_no_photos(tmp_path):
    with raises(InputError, 4, "depth") as caught:
        choose(tmp_path / "depth", pictures(tmp_path / "depth", a="I;16"))
    assert f"recon ingest {tmp_path}" in caught.value.hint


@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.parametrize("unit", [1000, 6553.5])  # millimetres, and a room over all 16 bits
def test_depth_maps_alone_are_no_photos_whatever_they_are_called(tmp_path, suffix, unit):
    row, column = np.mgrid[:48, :64]
    for index in range(4):  # a floor and a wall
        z = np.minimum(4.0, 60 / (row + 2 + index)) + 0.01 * column
        Image.fromarray(np.rint(unit * z).astype(np.uint16)).save(tmp_path / f"{index}.{suffix}")
    with raises(InputError, 4, "depth"):
        choose(tmp_path, list_photos(tmp_path.iterdir()).photos)


def test_depth_beside_a_single_coloured_picture_is_not_kept(tmp_path):
    listed = pictures(tmp_path, a="depth")
    Image.new("RGB", (8, 6)).save(tmp_path / "logo.png")
    (logo,) = list_photos([tmp_path / "logo.png"]).photos
    photos, notices = choose(tmp_path, [*listed, logo])
    assert photos == (logo,)
    assert_facts(notices[0], 4, "pictures", "depth")


@pytest.mark.parametrize(("name", "program"), [("a.webp", "magick"), ("a.png", "ffmpeg")])
def test_an_animation_is_called_one_with_what_turns_it_into_photos(tmp_path, name, program):
    frames = [Image.new("RGB", (8, 8), (40 * index, 9, 9)) for index in range(5)]
    frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:])
    (photo,) = list_photos([tmp_path / name]).photos
    with raises(InputError, 5, "animation") as caught:
        check_count(tmp_path / name, [photo], {})
    assert f"{program} " in caught.value.hint
    assert "recon ingest" in caught.value.hint
    assert_facts(choose(tmp_path, [photo])[1][0], 5, "pictures")


def test_a_folder_with_a_video_but_no_photos_names_it(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "walk.mp4").touch()
    with pytest.raises(InputError) as caught:
        check_count(tmp_path, [], {})
    assert f"recon ingest {tmp_path}/in/walk.mp4" in caught.value.hint


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
    (notice,) = group_notices(groups)
    assert_facts(notice, 5, *(f"1 of {group.name}" for group in groups))


def test_a_picture_that_fits_no_other_is_named():
    groups = group_photos([shot("a"), shot("b"), shot("logo.png", 100, 20)])
    assert [one.path.name for one in odd_photos(groups)] == ["logo.png"]
    assert_facts(group_notices(groups)[1], "logo.png", "100x20", "EXIF")


@pytest.mark.parametrize("single", [
    shot("b", 100, 20, camera="One"), shot("b", 100, 20, mm=4.3), shot("b")])
def test_what_has_exif_or_the_size_of_others_is_not_odd(single):
    assert odd_photos(group_photos([shot("a"), shot("c", camera="Two"), single])) == []


@pytest.mark.integration
@given(st.lists(st.tuples(st.sampled_from([48, 64]), st.sampled_from(["", "One"])), max_size=8))
def test_every_photo_is_in_one_group_and_names_differ(kinds):
    photos = [shot(str(k), width, camera=camera) for k, (width, camera) in enumerate(kinds)]
    groups = group_photos(photos)
    assert sorted(str(p.path) for g in groups for p in g.photos) == sorted(
        str(p.path) for p in photos)
    assert len({group.name for group in groups}) == len(groups)


def test_depth_beside_few_photos_is_not_taken_for_photos(tmp_path):
    # an app saves depth for every frame, and a photo for some
    for number in range(12):
        depth = np.full((30, 40), 900 + number, np.uint16)
        Image.fromarray(depth).save(tmp_path / f"depth_{number:05d}.png")
        Image.fromarray(np.full((30, 40), 2, np.uint8)).save(tmp_path / f"conf_{number:05d}.png")
    for number in range(4):
        Image.new("RGB", (80, 60), (number, 90, 60)).save(tmp_path / f"frame_{number:05d}.jpg")
    found = list_photos(sorted(tmp_path.iterdir())).photos
    rest, notices = choose(tmp_path, found)
    assert {photo.name for photo in rest} == {f"frame_{number:05d}.jpg" for number in range(4)}
    assert len(notices) == 2
