"""What ingest makes of a folder of photos that are not all alike."""

import json
import logging

import numpy as np
import pytest
from dng import Shot, linear, write_shot
from facts import assert_facts
from ingest_media import blocks, listed, take, write_photos
from PIL import Image

from recon_cli.config.stages import IngestConfig
from recon_cli.errors import InputError


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
    assert notices()[0] == (
        "The photos form 2 groups with separate intrinsics: 3 of 128x96, 2 of 96x128.")
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
    with pytest.raises(InputError, match=r"2 that cannot.*IMG_0001\.png has 48x48"):
        take(folder, tmp_path / "out")
    (folder / "masks" / "IMG_0002.png").unlink()
    assert take(folder, tmp_path / "out").skipped == ("IMG_0001.jpg",)
    assert any("The mask IMG_0001.png has 48x48" in notice for notice in notices())


def test_masks_that_are_all_broken_are_named_as_masks_with_what_helps(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    for index in range(4):
        mask_of(folder / "masks", f"IMG_{index:04d}.png", np.ones((48, 64), np.uint8))
    with pytest.raises(InputError, match=r"The mask IMG_0000\.png.*Write masks with 0 and 255"):
        take(folder, tmp_path / "out")


def test_where_no_mask_is_called_like_a_photo_the_right_name_is_told(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    for index in range(12):
        mask_of(folder / "masks", f"IMG_{index:04d}_mask.png", np.full((48, 64), 255, np.uint8))
    take(folder, tmp_path / "out")
    assert "and 4 more" in notices()[0]
    assert "must be called IMG_0000.png or IMG_0000.jpg.png" in notices()[1]


def test_of_many_broken_photos_the_first_are_told_one_by_one(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    for index in range(12):
        (folder / f"X{index:02d}.jpg").touch()
    take(folder, tmp_path / "out")
    assert sum("A photo is left out" in text for text in notices()) == 8
    assert notices()[8].startswith("4 more photos are left out")


def test_a_split_that_leaves_nothing_to_train_on_is_refused(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    with pytest.raises(InputError, match="4 of 4 frames are held out, which leaves 0"):
        take(folder, tmp_path / "out", config=IngestConfig(holdout="segment:0:1"))


def test_options_without_effect_on_photos_are_told(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    take(folder, tmp_path / "out", config=IngestConfig(holdout="segment:0:0.01", frames=3))
    holdout, frames = notices()
    assert_facts(holdout, "--holdout segment:0:0.01", "none of 4 frames")
    assert_facts(frames, "--frames", "no effect", "photos")


def test_a_photo_that_is_given_twice_is_taken_once(tmp_path):
    files = sorted(write_photos(tmp_path / "room", 4).iterdir())
    assert take((*files, files[0]), tmp_path / "out").frames == 4


def test_a_file_name_cannot_pass_for_a_message(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 4)
    (folder / "a\nerror: \x1b[31mb.jpg").touch()
    take(folder, tmp_path / "out")
    assert notices() == [
        r"A photo is left out: a\nerror: \x1b[31mb.jpg cannot be read: it is empty (0 bytes)."]


def test_photos_in_an_inner_folder_are_taken_and_their_masks_beside_it(tmp_path, notices):
    (tmp_path / "room").mkdir()
    write_photos(tmp_path / "room" / "images", 3)
    mask = np.full((48, 64), 255, np.uint8)
    mask[0] = 0
    mask_of(tmp_path / "room" / "masks", "IMG_0000.png", mask)
    assert take(tmp_path / "room", tmp_path / "out").frames == 3
    assert listed(tmp_path / "out")["frames"][0]["masked"]
    assert "those in images/ are used" in notices()[0]


def write_raw(folder, stops):
    folder.mkdir()
    light = linear(blocks(96, 128)) * 0.3
    for index, ev in enumerate(stops):
        view = np.roll(light, 8 * index, axis=1)  # another view, with the same mean
        write_shot(folder / f"IMG_{index:04d}.dng", view * 2.0**ev, Shot(iso=int(100 * 2.0**ev)))
    return folder


def test_raw_photos_are_developed_alike_and_the_gains_are_recorded(tmp_path):
    folder = write_raw(tmp_path / "room", [0, 1, 0, -1])
    take(folder, tmp_path / "out")
    plan = json.loads((tmp_path / "out" / "raw.json").read_text())
    gains = [shot["gain_ev"] for shot in plan["shots"].values()]
    np.testing.assert_allclose(np.array(gains) - gains[0], [0, -1, 0, 1], atol=0.01)
    names = [frame["name"] for frame in listed(tmp_path / "out")["frames"]]
    levels = [
        linear(np.asarray(Image.open(tmp_path / "out" / "frames" / name))).mean()
        for name in names]
    assert np.ptp(levels) / np.median(levels) < 0.02


def test_a_plan_that_is_there_is_kept_and_gives_the_same_frames(tmp_path, monkeypatch):
    folder = write_raw(tmp_path / "room", [0, 1, 0])
    take(folder, tmp_path / "out")
    frame = tmp_path / "out" / "frames" / "IMG_0001.png"
    before = frame.read_bytes()
    frame.unlink()

    def never(*_args, **_options):
        raise AssertionError("planned again")

    monkeypatch.setattr("recon_cli.capture.from_photos.plan_raw", never)
    take(folder, tmp_path / "out")
    assert frame.read_bytes() == before


def test_a_jpeg_beside_its_raw_is_left_out_and_told(tmp_path, notices):
    folder = write_raw(tmp_path / "room", [0, 0, 0])
    write_photos(folder, 2)
    assert take(folder, tmp_path / "out").frames == 3
    assert [frame["source"] for frame in listed(tmp_path / "out")["frames"]] == [
        "IMG_0000.dng", "IMG_0001.dng", "IMG_0002.dng"]
    assert "2 photos are left out" in notices()[0]


def test_a_jpeg_takes_the_place_of_its_broken_raw(tmp_path):
    folder = write_raw(tmp_path / "room", [0, 0, 0])
    write_photos(folder, 1)
    (folder / "IMG_0000.dng").write_bytes(b"no RAW")
    take(folder, tmp_path / "out")
    assert [frame["source"] for frame in listed(tmp_path / "out")["frames"]] == [
        "IMG_0000.jpg", "IMG_0001.dng", "IMG_0002.dng"]


def test_photos_may_be_given_one_by_one(tmp_path):
    folder = write_photos(tmp_path / "room", 5)
    take(folder, tmp_path / "folder")
    take(tuple(sorted(folder.iterdir(), reverse=True)), tmp_path / "files")
    assert listed(tmp_path / "files")["frames"] == listed(tmp_path / "folder")["frames"]


def test_photos_of_one_name_are_not_told_apart(tmp_path):
    paths = []
    for name in ("a", "b"):
        paths += sorted(write_photos(tmp_path / name, 2).iterdir())
    with pytest.raises(InputError, match=r"2 photos are called IMG_0000\.jpg"):
        take(tuple(paths), tmp_path / "out")
