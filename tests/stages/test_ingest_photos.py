"""Ingest of a folder of photos that are not all alike."""

import json
import logging
import shutil

import numpy as np
import pytest
from facts import assert_facts, raises
from ingest_media import blocks, listed, take, walk, write_photos, write_sequence
from PIL import Image

from recon_cli.config.stages import IngestConfig
from recon_cli.errors import InputError
from recon_cli.io.tracks import Tracks
from recon_cli.scene.camera import panorama_lens
from recon_cli.workspace.records import read_frame_list


@pytest.fixture
def notices(caplog):
    caplog.set_level(logging.WARNING, logger="recon")
    return lambda: [record.getMessage() for record in caplog.records]


def mask_of(folder, name, mask):
    folder.mkdir(exist_ok=True)
    Image.fromarray(mask).save(folder / name)


def test_mixed_sizes_become_groups_and_are_told(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4, size=(128, 96))
    Image.fromarray(blocks(128, 96)).save(folder / "IMG_0001.jpg")
    Image.fromarray(blocks(128, 96, seed=7)).save(folder / "IMG_0009.jpg")
    summary = take(folder, tmp_path / "out", config=IngestConfig(max_size=64))
    assert (summary.groups, summary.frames, summary.lost_frames) == (2, 5, 0)
    written = listed(tmp_path / "out")
    assert [(g["name"], g["width"], g["height"]) for g in written["groups"]] == [
        ("room: 128x96", 64, 48), ("room: 96x128", 48, 64)]
    assert [frame["group"] for frame in written["frames"]] == [0, 1, 0, 0, 1]
    assert_facts(notices()[0], 2, "3 of 128x96", "2 of 96x128")
    assert len(notices()) == 3  # each size is reduced


def test_masks_are_stored_at_the_size_of_their_frames(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 3, size=(128, 96))
    mask = np.zeros((96, 128), np.uint8)
    mask[:, 64:] = 255
    mask_of(folder / "masks", "IMG_0001.png", mask)
    mask_of(folder / "masks", "other.png", mask)
    take(folder, tmp_path / "out", config=IngestConfig(max_size=64))
    frames = listed(tmp_path / "out")["frames"]
    assert [frame["masked"] for frame in frames] == [False, True, False]
    stored = np.asarray(Image.open(tmp_path / "out" / "masks" / "IMG_0001.png"))
    np.testing.assert_array_equal(stored, mask[::2, ::2])
    assert any("other.png" in notice for notice in notices())


def test_transparency_becomes_a_mask(tmp_path):
    folder = write_photos(tmp_path / "room", 3, suffix=".png")
    rgba = np.dstack([blocks(48, 64), np.full((48, 64), 255, np.uint8)])
    rgba[:20, :, 3] = 0
    Image.fromarray(rgba).save(folder / "IMG_0001.png")
    take(folder, tmp_path / "out")
    assert [frame["masked"] for frame in listed(tmp_path / "out")["frames"]] == [
        False, True, False]
    stored = np.asarray(Image.open(tmp_path / "out" / "masks" / "IMG_0001.png"))
    np.testing.assert_array_equal(stored, rgba[..., 3])


def test_a_photo_whose_mask_is_broken_is_left_out_and_named(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    mask_of(folder / "masks", "IMG_0001.png", np.full((48, 48), 255, np.uint8))
    mask_of(folder / "masks", "IMG_0002.png", np.zeros((48, 64), np.uint8))
    with raises(InputError, 2, "IMG_0001.png", "48x48"):
        take(folder, tmp_path / "out")
    (folder / "masks" / "IMG_0002.png").unlink()
    assert take(folder, tmp_path / "out").skipped == ("IMG_0001.jpg",)
    assert_facts("\n".join(notices()), "IMG_0001.png", "48x48")


def test_masks_that_are_all_broken_are_named_as_masks_with_what_helps(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    for index in range(4):
        mask_of(folder / "masks", f"IMG_{index:04d}.png", np.ones((48, 64), np.uint8))
    with raises(InputError, "IMG_0000.png", 0, 255):
        take(folder, tmp_path / "out")


def test_where_no_mask_is_called_like_a_photo_the_right_name_is_told(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    for index in range(12):
        mask_of(folder / "masks", f"IMG_{index:04d}_mask.png", np.full((48, 64), 255, np.uint8))
    take(folder, tmp_path / "out")
    assert_facts(notices()[0], 7)
    assert_facts(notices()[1], "IMG_0000.png", "IMG_0000.jpg.png")


def test_of_many_broken_photos_the_first_are_told_one_by_one(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    for index in range(12):
        (folder / f"X{index:02d}.jpg").touch()
    take(folder, tmp_path / "out")
    assert [text.count(".jpg") for text in notices()[:5]] == [1] * 5
    assert_facts(notices()[5], 7, "photos", "left")


def test_a_split_that_leaves_nothing_to_train_on_is_refused(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    with raises(InputError, 4, 0, "frames"):
        take(folder, tmp_path / "out", config=IngestConfig(holdout="segment:0:1"))


def test_options_without_effect_on_photos_are_told(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    take(folder, tmp_path / "out", config=IngestConfig(holdout="segment:0:0.01", frames=3))
    holdout, frames = notices()
    assert_facts(holdout, "--holdout", "segment:0:0.01", 4)
    assert_facts(frames, "--frames", "photos")


def test_a_photo_that_is_given_twice_is_taken_once(tmp_path):
    files = sorted(write_photos(tmp_path / "room", 4).iterdir())
    assert take((*files, files[0]), tmp_path / "out").frames == 4


def test_a_file_name_cannot_pass_for_a_message(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    (folder / "a\nerror: \x1b[31mb.jpg").touch()
    take(folder, tmp_path / "out")
    (notice,) = notices()
    assert_facts(notice, r"a\nerror: \x1b[31mb.jpg", 0)
    assert len(notice.splitlines()) == 1


def test_photos_in_an_inner_folder_are_taken_and_their_masks_beside_it(tmp_path, notices):
    (tmp_path / "room").mkdir()
    write_photos(tmp_path / "room" / "images", 3)
    mask = np.full((48, 64), 255, np.uint8)
    mask[0] = 0
    mask_of(tmp_path / "room" / "masks", "IMG_0000.png", mask)
    assert take(tmp_path / "room", tmp_path / "out").frames == 3
    assert listed(tmp_path / "out")["frames"][0]["masked"]
    assert_facts(notices()[0], "images/")


def test_photos_may_be_given_one_by_one(tmp_path):
    folder = write_photos(tmp_path / "room", 5)
    take(folder, tmp_path / "folder")
    take(tuple(sorted(folder.iterdir(), reverse=True)), tmp_path / "files")
    assert listed(tmp_path / "files")["frames"] == listed(tmp_path / "folder")["frames"]


def test_photos_of_one_name_are_not_told_apart(tmp_path):
    paths = []
    for name in ("a", "b"):
        paths += sorted(write_photos(tmp_path / name, 2).iterdir())
    with raises(InputError, 2, "IMG_0000.jpg"):
        take(tuple(paths), tmp_path / "out")


@pytest.mark.integration
def test_a_folder_of_all_frames_of_a_video_is_thinned_like_one(tmp_path, notices):
    folder = write_sequence(tmp_path / "dump", 110)
    summary = take(folder, tmp_path / "out", config=IngestConfig(frames=24))
    frames = listed(tmp_path / "out")["frames"]
    assert (summary.kind, summary.frames, summary.decoded_frames) == ("photos", 24, 110)
    assert summary.skipped == ()
    places = [int(frame["name"][6:10]) for frame in frames]
    assert max(np.diff(places)) <= 8
    assert [frame["source"] for frame in frames] == [f"frame_{place:04d}.jpg" for place in places]
    assert sorted(path.name for path in (tmp_path / "out" / "frames").iterdir()) == [
        frame["name"] for frame in frames]
    notice, = notices()
    assert_facts(notice, "dump", "24 of 110", "--frames")
    record = json.loads((tmp_path / "out" / "choice.json").read_text())
    assert record["counts"] == {"kept": 24, "close": 86}
    assert [one["name"] for one in record["candidates"] if one["reason"] == "kept"] == [
        frame["name"] for frame in frames]
    assert record["candidates"][1]["source"] == "frame_0001.jpg"
    assert all(one["like"] in places for one in record["candidates"] if one["reason"] == "close")
    sheet = np.asarray(Image.open(tmp_path / "out" / "contact.png").convert("RGB"))
    assert (sheet[-200:] != 255).any(axis=2).mean() > 0.3  # dropped photos have pictures, too


@pytest.mark.integration
def test_the_number_of_frames_of_a_sequence_can_be_set_up_to_all(tmp_path, notices):
    folder = write_sequence(tmp_path / "dump", 60)
    assert take(folder, tmp_path / "few", config=IngestConfig(frames=40)).frames == 40
    assert_facts(notices()[0], "40 of 60", "--frames")
    every = take(folder, tmp_path / "all", config=IngestConfig(frames=60, max_frames=30))
    assert every.frames == 60
    assert take(folder, tmp_path / "default").frames == 60
    assert len(notices()) == 1


@pytest.mark.integration
@pytest.mark.parametrize("count", [99, 100, 101, 104])
def test_no_photo_more_costs_a_short_walk_its_views(tmp_path, count):
    folder = write_sequence(tmp_path / "dump", count)
    assert take(folder, tmp_path / "out").frames == min(count, 100)


@pytest.mark.integration
def test_photos_that_follow_each_other_get_tracks_by_the_names_of_their_frames(tmp_path):
    folder = write_sequence(tmp_path / "dump", 40)
    for path in folder.iterdir():
        path.rename(folder / f"{int(path.stem[6:]) + 1}.jpg")  # 1, 2, 10: in no order of letters
    take(folder, tmp_path / "out")
    frames = listed(tmp_path / "out")["frames"]
    assert [frame["source"] for frame in frames] == [f"{index}.jpg" for index in range(1, 41)]
    assert all(frame["sharpness"] > 0 for frame in frames)
    tracks = Tracks.read(tmp_path / "out" / "tracks.safetensors")
    assert list(tracks.names) == [frame["name"] for frame in frames] == sorted(tracks.names)
    before, after = tracks.matches(10, 15)
    assert len(after) > 15
    assert (tracks.xy[after, 0] < tracks.xy[before, 0]).all()


@pytest.mark.integration
def test_of_frames_that_are_there_twice_one_is_taken(tmp_path):
    folder = write_sequence(tmp_path / "dump", 30)
    for path in list(folder.iterdir()):
        shutil.copy(path, folder / f"frame_{int(path.stem[6:]):04d}1.jpg")
        path.rename(folder / f"frame_{int(path.stem[6:]):04d}0.jpg")
    summary = take(folder, tmp_path / "out")
    assert (summary.frames, summary.decoded_frames) == (30, 60)


@pytest.mark.integration
def test_tracks_leave_out_what_a_mask_hides(tmp_path):
    folder = write_sequence(tmp_path / "dump", 30)
    mask = np.full((192, 256), 255, np.uint8)
    mask[:, :128] = 0
    mask_of(folder / "masks", "frame_0010.png", mask)
    take(folder, tmp_path / "out")
    tracks = Tracks.read(tmp_path / "out" / "tracks.safetensors")
    left = {image: (tracks.xy[tracks.image == image, 0] < 0.49).sum() for image in (9, 10)}
    assert left[9] > 0 == left[10]


@pytest.mark.integration
def test_a_copy_beside_a_sequence_is_left_out_and_what_shows_more_is_kept(tmp_path, notices):
    folder = tmp_path / "dump"
    folder.mkdir()
    for index, rgb in enumerate(walk(40, step=8, height=192, width=256)):
        Image.fromarray(rgb).save(folder / f"frame_{index:04d}.jpg", quality=95)
    shutil.copy(folder / "frame_0020.jpg", folder / "copy.jpg")
    detail = Image.open(folder / "frame_0000.jpg").crop((20, 20, 220, 170))
    detail.resize((256, 192)).save(folder / "detail.jpg", quality=95)
    summary = take(folder, tmp_path / "out")
    assert (summary.frames, summary.skipped) == (41, ("copy.jpg",))
    assert_facts("\n".join(notices()), "copy.jpg", "frame_0020.jpg")


@pytest.mark.integration
def test_pictures_of_another_scene_are_set_aside_by_name(tmp_path, notices):
    folder = write_sequence(tmp_path / "dump", 60)
    for index, name in enumerate(("frame_0021.jpg", "frame_0041.jpg", "cat.jpg")):
        Image.fromarray(blocks(192, 256, seed=index + 1)).save(folder / name)
    summary = take(folder, tmp_path / "out")
    assert (summary.frames, summary.declared_frames) == (58, 61)
    assert summary.skipped == ("cat.jpg", "frame_0021.jpg", "frame_0041.jpg")
    assert_facts(notices()[0], "3 photos", "cat.jpg", "frame_0021.jpg", "frame_0041.jpg")
    tracks = Tracks.read(tmp_path / "out" / "tracks.safetensors")
    assert len(tracks.matches(tracks.names.index("frame_0020.png"),
                              tracks.names.index("frame_0022.png"))[0]) > 15


@pytest.mark.integration
def test_a_few_pictures_of_another_size_are_set_aside_unless_they_show_the_scene(tmp_path, notices):
    folder = tmp_path / "room"
    write_photos(folder, 18, size=(256, 192))
    Image.open(folder / "IMG_0003.jpg").crop((30, 20, 210, 170)).save(folder / "part.png")
    Image.fromarray(blocks(200, 200, seed=99)).save(folder / "x.png")
    summary = take(folder, tmp_path / "out")
    assert summary.skipped == ("x.png",)
    assert summary.frames == 19
    assert_facts(notices()[0], 1, "x.png")


@pytest.mark.integration
def test_a_broken_photo_of_a_sequence_is_left_out_and_named(tmp_path, notices):
    folder = write_sequence(tmp_path / "dump", 60)
    damaged = folder / "frame_0030.jpg"
    damaged.write_bytes(damaged.read_bytes()[:2000])
    summary = take(folder, tmp_path / "out", config=IngestConfig(frames=59))
    assert (summary.frames, summary.lost_frames, summary.decoded_frames) == (59, 1, 59)
    assert summary.skipped == ("frame_0030.jpg",)
    assert_facts("\n".join(notices()), "frame_0030.jpg")
    record = json.loads((tmp_path / "out" / "choice.json").read_text())["candidates"][30]
    assert (record["reason"], record["name"], record["sharpness"]) == ("damaged", None, None)


@pytest.mark.integration
def test_a_mask_that_does_not_fit_its_frame_of_a_sequence_costs_that_frame(tmp_path):
    folder = write_sequence(tmp_path / "dump", 60)
    for index in range(60):
        mask_of(folder / "masks", f"frame_{index:04d}.png",
                np.full((192, 256) if index != 20 else (8, 8), 255, np.uint8))
    summary = take(folder, tmp_path / "out", config=IngestConfig(frames=59, sharpness=0.0))
    assert "frame_0020.jpg" in summary.skipped
    assert summary.frames == 58
    record = json.loads((tmp_path / "out" / "choice.json").read_text())["candidates"][20]
    assert (record["reason"], record["name"]) == ("damaged", None)


def test_photos_beside_and_in_subfolders_are_all_used(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 3)
    for index, path in enumerate(sorted(write_photos(tmp_path / "more", 6).iterdir())[3:]):
        path.rename(tmp_path / f"{path.name}")
        (folder / "more").mkdir(exist_ok=True)
        (tmp_path / path.name).rename(folder / "more" / f"IMG_{index:04d}.jpg")
    (folder / "more" / "IMG_0000.jpg").rename(folder / "more" / "IMG_0009.jpg")
    (folder / "more" / "IMG_0001.jpg").rename(folder / "more" / "IMG_0008.jpg")
    mask = np.full((48, 64), 255, np.uint8)
    mask[0] = 0
    mask_of(folder / "masks", "IMG_0000.png", mask)
    (folder / "masks" / "more").mkdir()
    mask_of(folder / "masks" / "more", "IMG_0002.png", mask)
    assert take(folder, tmp_path / "out").frames == 6
    frames = listed(tmp_path / "out")["frames"]
    assert [(frame["source"], frame["masked"]) for frame in frames] == [
        ("IMG_0000.jpg", True), ("IMG_0001.jpg", False), ("IMG_0002.jpg", False),
        ("more/IMG_0002.jpg", True), ("more/IMG_0008.jpg", False), ("more/IMG_0009.jpg", False)]
    assert_facts("\n".join(notices()), 3, "more/")


def test_values_of_twelve_bits_are_no_dark_photos(tmp_path, notices):
    folder = tmp_path / "room"
    folder.mkdir()
    for index in range(4):
        wide = blocks(48, 64, seed=index)[..., 0].astype(np.uint16) * 16
        Image.fromarray(wide).save(folder / f"{index}.png")
    take(folder, tmp_path / "out")
    (notice,) = notices()
    assert_facts(notice, "4 pictures", "12 bits", "4095")
    stored = np.asarray(Image.open(tmp_path / "out" / "frames" / "0.png"))
    expected = blocks(48, 64)[..., 0].astype(float) * 16 / 4095 * 255
    assert np.abs(stored[..., 0] - expected).max() <= 0.51


def test_panoramas_are_not_taken_for_photos(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 3)
    xmp = b'<r GPano:ProjectionType="equirectangular"/>'
    for index in range(3):
        Image.fromarray(blocks(64, 128, seed=9 + index)).save(
            folder / f"pano_{index}.jpg", xmp=xmp)
    assert take(folder, tmp_path / "out").frames == 3
    assert_facts("\n".join(notices()), 3, "panoramas", "left")
    for path in folder.glob("IMG_*"):
        path.unlink()
    assert take(folder, tmp_path / "again").frames == 3
    (group,) = read_frame_list(tmp_path / "again").groups
    assert group.lens == panorama_lens(128, 64)
    mask = np.asarray(Image.open(tmp_path / "again" / "masks" / "pano_0.png"))
    assert (mask[:54] == 255).all()
    assert (mask[56:] == 0).all()  # 25 degrees around the lowest point are 8.9 rows


def test_panoramas_and_photos_as_two_inputs_are_refused(tmp_path):
    photos = write_photos(tmp_path / "photos", 3)
    xmp = b'<r GPano:ProjectionType="equirectangular"/>'
    (tmp_path / "panoramas").mkdir()
    for index in range(3):
        Image.fromarray(blocks(64, 128, seed=9 + index)).save(
            tmp_path / "panoramas" / f"{index}.jpg", xmp=xmp)
    with raises(InputError, "360-degree"):
        take((photos, tmp_path / "panoramas"), tmp_path / "out")


def test_a_cropped_panorama_is_used_in_its_place_of_the_sphere(tmp_path):
    folder = tmp_path / "room"
    folder.mkdir()
    xmp = (b'<r GPano:ProjectionType="equirectangular" GPano:CroppedAreaImageWidthPixels="128" '
           b'GPano:CroppedAreaImageHeightPixels="40" GPano:FullPanoWidthPixels="128" '
           b'GPano:FullPanoHeightPixels="64" GPano:CroppedAreaLeftPixels="0" '
           b'GPano:CroppedAreaTopPixels="12"/>')
    for index in range(3):
        Image.fromarray(blocks(40, 128, seed=index)).save(folder / f"p{index}.jpg", xmp=xmp)
    take(folder, tmp_path / "out")
    assert read_frame_list(tmp_path / "out").groups[0].lens == panorama_lens(128, 64)
    mask = np.asarray(Image.open(tmp_path / "out" / "masks" / "p0.png"))
    assert (mask[12:52] == 255).all()
    assert (mask[:12] == 0).all()
    assert np.asarray(Image.open(tmp_path / "out" / "frames" / "p0.png")).shape == (64, 128, 3)


def test_poses_and_lists_beside_photos_are_named(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 3)
    (folder / "bundle.out").write_text("# Bundle file v0.3\n")
    (folder / "places.txt").write_text("".join(f"IMG_{k:04d}.jpg 1 2 3\n" for k in range(3)))
    take(folder, tmp_path / "out")
    assert_facts("\n".join(notices()), "bundle.out")
    assert_facts("\n".join(notices()), "places.txt")
    found = len(notices())
    take(tuple(sorted(folder.glob("*.jpg"))), tmp_path / "files")
    assert any("bundle.out" in notice for notice in notices()[found:])


def test_masks_beside_given_files_are_named(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 3)
    mask_of(folder / "masks", "IMG_0001.png", np.full((48, 64), 255, np.uint8))
    take(tuple(sorted(folder.glob("*.jpg"))), tmp_path / "out")
    assert_facts("\n".join(notices()), "masks", "files")


def test_the_border_of_fisheye_photos_is_masked_beside_their_own_masks(tmp_path):
    folder = tmp_path / "round"
    folder.mkdir()
    x, y = np.meshgrid(np.arange(128) + 0.5 - 64, np.arange(96) + 0.5 - 48)
    disk = (np.hypot(x, y) < 45)[..., None]
    for index in range(4):
        Image.fromarray(blocks(96, 128, seed=index) * disk).save(folder / f"{index}.png")
    own = np.full((96, 128), 255, np.uint8)
    own[40:50, 60:70] = 0
    mask_of(folder / "masks", "2.png", own)
    take(folder, tmp_path / "out")
    masks = {path.stem: np.asarray(Image.open(path)) for path in (
        tmp_path / "out" / "masks").iterdir()}
    assert len(masks) == 4
    assert all(frame["masked"] for frame in listed(tmp_path / "out")["frames"])
    assert all(not mask[~disk[..., 0]].any() for mask in masks.values())
    assert not masks["2"][40:50, 60:70].any()
    assert masks["1"][40:50, 60:70].all()
