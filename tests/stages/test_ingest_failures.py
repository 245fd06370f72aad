"""ingest on captures that are damaged, too small, or not captures at all."""

import errno
import logging
import os
import zipfile

import numpy as np
import pytest
from facts import assert_facts, raises
from ingest_media import blocks, files, listed, take, walk, write_photos, write_video
from PIL import Image

from recon_cli.errors import InputError
from recon_cli.io import images


@pytest.fixture
def video(tmp_path):
    return write_video(tmp_path / "walk.mp4", walk(40))


@pytest.fixture
def notices(caplog):
    caplog.set_level(logging.WARNING, logger="recon")
    return lambda: [record.getMessage() for record in caplog.records]


@pytest.mark.integration
def test_a_video_cut_off_goes_on_with_what_is_left(video, tmp_path, notices):
    data = video.read_bytes()
    video.write_bytes(data[:len(data) // 2])
    summary = take(video, tmp_path / "out")
    assert summary.declared_frames == 40
    assert 3 <= summary.decoded_frames < 40
    assert summary.lost_frames == 40 - summary.decoded_frames
    assert len(notices()) == 1
    assert_facts(notices()[0], summary.lost_frames, 40, "frames", "lost")


@pytest.mark.integration
@pytest.mark.parametrize("filler", [b"\0", b"\xa5"])
def test_a_video_corrupted_in_the_middle_goes_on_around_the_damage(
        tmp_path, notices, filler):
    video = write_video(
        tmp_path / "walk.mp4", walk(60), options={"g": "10", "sc_threshold": "0"})
    data = bytearray(video.read_bytes())
    middle = len(data) // 2
    data[middle:middle + 1500] = filler * 1500
    video.write_bytes(data)
    summary = take(video, tmp_path / "out")
    assert 1 <= summary.lost_frames <= 20  # at most the two groups that the hole may touch
    assert summary.decoded_frames == 60 - summary.lost_frames
    assert_facts(notices()[0], summary.lost_frames, 60, "frames", "lost")
    for frame in listed(tmp_path / "out")["frames"]:
        rgb = images.read_png(tmp_path / "out" / "frames" / frame["name"])
        truth = walk(60)[int(frame["time_seconds"] * 10 + 0.5)].astype(float)
        assert np.abs(rgb - truth).mean() < 20


def test_a_video_that_lost_nearly_all_is_refused(tmp_path):
    video = write_video(tmp_path / "walk.mp4", walk(40))
    data = bytearray(video.read_bytes())
    start = data.index(b"mdat") + 2000
    data[start:] = bytes(len(data) - start)
    video.write_bytes(data)
    with raises(InputError, "frame", video):
        take(video, tmp_path / "out")


def test_a_video_cut_off_before_its_index_is_refused(tmp_path, sample_video):
    data = sample_video.read_bytes()
    (tmp_path / "head.mp4").write_bytes(data[:1000])
    with raises(InputError, "truncated", "index"):
        take(tmp_path / "head.mp4", tmp_path / "out")


def test_a_video_of_two_frames_is_refused(tmp_path):
    video = write_video(tmp_path / "short.mp4", walk(2))
    with raises(InputError, 2, 3, "undamaged"):
        take(video, tmp_path / "out")


@pytest.mark.parametrize(("value", "fault"), [(0, "dark"), (255, "over-exposed"), (128, "flat")])
def test_a_video_that_shows_nothing_is_refused_with_the_reason(tmp_path, value, fault):
    video = write_video(tmp_path / "dark.mp4", [np.full((96, 128, 3), value, np.uint8)] * 40)
    with raises(InputError, "dark.mp4", fault):
        take(video, tmp_path / "out")


def test_a_video_from_a_tripod_is_refused(tmp_path):
    video = write_video(tmp_path / "still.mp4", [blocks(96, 128)] * 40)
    with raises(InputError, "still.mp4", 40):
        take(video, tmp_path / "out")


@pytest.mark.integration
def test_a_video_that_is_dark_for_the_most_part_is_told(tmp_path, notices):
    lit = walk(30)
    take(write_video(tmp_path / "room.mp4", [*lit[:10], *(frame // 64 for frame in lit[10:])]),
         tmp_path / "out")
    assert_facts(notices()[0], "20 of 30", "room.mp4", "black")


@pytest.mark.integration
def test_adjacent_frames_are_warned_of(tmp_path, notices):
    wide = blocks(384, 560)  # a third of a percent of the width a frame, as at 60 a second
    take(write_video(tmp_path / "short.mp4", [wide[:, i:i + 384] for i in range(12)]),
         tmp_path / "out")
    assert_facts(notices()[0], "short.mp4", "moves")


def test_copies_of_one_photo_are_refused(tmp_path):
    folder = tmp_path / "room"
    folder.mkdir()
    for index in range(12):
        Image.fromarray(blocks(48, 64)).save(folder / f"{index}.jpg")
    with raises(InputError, 12, 1, "different"):
        take(folder, tmp_path / "out")


def test_two_photos_are_refused(tmp_path):
    with raises(InputError, 2, 3, "photos"):
        take(write_photos(tmp_path / "room", 2), tmp_path / "out")


def test_a_source_that_is_not_there_is_refused(tmp_path):
    with raises(InputError, "room.mp4"):
        take(tmp_path / "room.mp4", tmp_path / "out")


def test_one_missing_source_of_several_is_refused(video, tmp_path):
    with raises(InputError, "gone.mp4"):
        take((video, tmp_path / "gone.mp4"), tmp_path / "out")
    assert not (tmp_path / "out" / "frames").exists()


def test_text_named_like_a_video_is_refused(tmp_path):
    (tmp_path / "room.mp4").write_text("this is not a video\n" * 50)
    with raises(InputError, "video"):
        take(tmp_path / "room.mp4", tmp_path / "out")


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "room.mp4").touch()
    with raises(InputError, "empty"):
        take(tmp_path / "room.mp4", tmp_path / "out")


def test_one_photo_is_refused(tmp_path):
    folder = write_photos(tmp_path / "room", 1)
    with raises(InputError, "IMG_0000.jpg", 1):
        take(folder / "IMG_0000.jpg", tmp_path / "out")
    with raises(InputError, 1, "photo"):
        take(folder, tmp_path / "out")


def test_a_folder_without_photos_is_refused(tmp_path):
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "notes.txt").write_text("nothing")
    with raises(InputError, "photos"):
        take(tmp_path / "room", tmp_path / "out")


def test_the_only_video_of_a_folder_without_photos_is_used(tmp_path, notices):
    folder = tmp_path / "room"
    (folder / "DCIM").mkdir(parents=True)
    write_video(folder / "DCIM" / "walk.mp4", walk(12))
    (folder / "._walk.mp4").write_bytes(b"of a Mac")
    write_photos(folder, 1)
    summary = take(folder, tmp_path / "out")
    assert (summary.kind, summary.decoded_frames) == ("video", 12)
    assert_facts("\n".join(notices()), "walk.mp4")


def test_several_videos_of_a_folder_are_left_to_the_user(tmp_path):
    folder = tmp_path / "room"
    folder.mkdir()
    for name in ("a.mp4", "b.mp4"):
        (folder / name).write_bytes(b"never opened")
    with pytest.raises(InputError) as caught:
        take(folder, tmp_path / "out")
    assert f"`recon ingest {folder / 'a.mp4'}`" in caught.value.hint
    assert "b.mp4" in caught.value.hint


def test_a_folder_of_unreadable_photos_is_refused(tmp_path):
    (tmp_path / "room").mkdir()
    for index in range(5):
        (tmp_path / "room" / f"{index}.jpg").write_bytes(b"\xff\xd8 broken")
    with raises(InputError, 5, "0.jpg"):
        take(tmp_path / "room", tmp_path / "out")


def test_half_a_jpeg_among_good_photos_is_left_out_and_named(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 6)
    half = folder / "IMG_0002.jpg"
    half.write_bytes(half.read_bytes()[:half.stat().st_size // 2])
    (folder / "IMG_0007.jpg").write_bytes(b"no photo at all")
    summary = take(folder, tmp_path / "out")
    assert (summary.frames, summary.lost_frames) == (5, 2)
    assert summary.skipped == ("IMG_0002.jpg", "IMG_0007.jpg")
    assert not (tmp_path / "out" / "frames" / "IMG_0002.png").exists()
    assert sum("IMG_0002.jpg" in text for text in notices()) == 1
    assert sum("IMG_0007.jpg" in text for text in notices()) == 1


def test_too_few_photos_that_are_whole_are_refused(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    for path in sorted(folder.iterdir())[:2]:
        path.write_bytes(path.read_bytes()[:path.stat().st_size // 2])
    with raises(InputError, 2, "photos"):
        take(folder, tmp_path / "out")


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["video", "photos"])
def test_a_full_disk_leaves_no_half_written_frame(video, tmp_path, monkeypatch, kind):
    source = video if kind == "video" else write_photos(tmp_path / "room", 5)
    flush, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with raises(OSError, errno.ENOSPC):
        take(source, tmp_path / "out")
    left = sorted((tmp_path / "out" / "frames").iterdir())
    assert 0 < len(left) <= 3
    for path in left:
        images.read_png(path)
    monkeypatch.setattr(os, "fsync", flush)
    take(source, tmp_path / "out")
    take(source, tmp_path / "undisturbed")
    assert files(tmp_path / "out") == files(tmp_path / "undisturbed")


def test_an_archive_or_poses_are_not_read_as_a_video(tmp_path):
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        for path in sorted(write_photos(tmp_path / "room", 4).iterdir()):
            archive.write(path, path.name)
    with raises(InputError, "archive", "video"):
        take(tmp_path / "photos.zip", tmp_path / "out")
    (tmp_path / "cameras.json").write_text("[]")
    with raises(InputError, "camera", "poses"):
        take(tmp_path / "cameras.json", tmp_path / "out")


@pytest.mark.integration
def test_poses_beside_the_video_of_an_app_are_named(tmp_path, notices):
    (tmp_path / "stray").mkdir()
    video = write_video(tmp_path / "stray" / "rgb.mp4", walk(20))
    (tmp_path / "stray" / "odometry.csv").write_text("timestamp, frame, x, y, z, qx, qy, qz, qw\n")
    with raises(InputError, "frame", "pose") as caught:
        take(tmp_path / "stray", tmp_path / "none")
    assert f"recon ingest {video}" in caught.value.hint
    found = len(notices())
    take(video, tmp_path / "out")
    assert_facts(notices()[found], "recording", "Stray", "Scanner")
    assert f"recon ingest {tmp_path / 'stray'} uses them" in notices()[found]
