import errno
import json
import logging
import os

import av
import numpy as np
import pytest
from PIL import Image

from recon_cli.capture import frames as store
from recon_cli.config import IngestConfig
from recon_cli.errors import InputError
from recon_cli.stages import ingest
from recon_cli.stages.context import StageContext, StageInputs


def take(source, out, *, config=None, threads=2, record=None):
    out.mkdir(parents=True, exist_ok=True)
    ctx = StageContext(threads=threads, **({"record": record} if record else {}))
    sources = source if isinstance(source, tuple) else (source,)
    return ingest.run(config or IngestConfig(), StageInputs(sources=sources), out, ctx)


def listed(out):
    return json.loads((out / "frames.json").read_text())


def files(out):
    """Every file of a folder with its bytes."""
    return {
        str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def blocks(height, width, seed=0):
    colours = np.random.default_rng(seed).integers(30, 226, (height // 4, width // 4, 3))
    return np.kron(colours, np.ones((4, 4, 1), int)).astype(np.uint8)


def write_video(path, frames, *, options=None):
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.options = {"qp": "10", **(options or {})}
        images = (av.VideoFrame.from_ndarray(np.ascontiguousarray(f), "rgb24") for f in frames)
        for image in [*images, None]:
            for packet in stream.encode(image):
                container.mux(packet)
    return path


def walk(frames, step=4, height=96, width=128):
    wide = blocks(height, width + frames * step)
    return [wide[:, i * step:i * step + width] for i in range(frames)]


def write_photos(folder, count, *, size=(64, 48), suffix=".jpg"):
    folder.mkdir(exist_ok=True)
    for index in range(count):
        rgb = blocks(size[1], size[0], seed=index)
        Image.fromarray(rgb).save(folder / f"IMG_{index:04d}{suffix}")
    return folder


@pytest.fixture
def video(tmp_path):
    return write_video(tmp_path / "walk.mp4", walk(40))


@pytest.fixture
def notices(caplog):
    caplog.set_level(logging.WARNING, logger="recon")
    return lambda: [record.getMessage() for record in caplog.records]


def test_a_video_becomes_sharp_frames_and_a_list_of_them(video, tmp_path, notices):
    summary = take(video, tmp_path / "out")
    found = listed(tmp_path / "out")
    names = [frame["name"] for frame in found["frames"]]
    assert summary == {
        "kind": "video", "declared_frames": 40, "decoded_frames": 40, "lost_frames": 0,
        "dropped_blurred": 0, "skipped": [], "frames": len(names), "held_out": -(-len(names) // 8),
        "width": 128, "height": 96,
    }
    assert (found["source"], found["width"], found["height"]) == ("video", 128, 96)
    assert found["focal_px"] is None
    assert names == sorted(names)
    assert names == sorted(path.name for path in (tmp_path / "out" / "frames").iterdir())
    for place, frame in enumerate(found["frames"]):
        index = int(frame["name"].removesuffix(".png"))
        assert frame["time_seconds"] == pytest.approx(index / 10)
        assert frame["source"] == "walk.mp4"
        assert frame["sharpness"] > 0
        assert frame["held_out"] == (place % 8 == 0)
        rgb = store.read_png(tmp_path / "out" / "frames" / frame["name"])
        truth = walk(40)[index].astype(float)
        # Half of the colour resolution is lost in the video; the wrong frame is off by 50.
        assert np.abs(rgb - truth).mean() < 12
    assert notices() == []


def test_the_bundled_video_gives_a_number_that_structure_from_motion_likes(sample_video, tmp_path):
    summary = take(sample_video, tmp_path / "out")
    assert 60 <= summary["frames"] <= 100
    assert (summary["width"], summary["height"], summary["lost_frames"]) == (600, 340, 0)


def test_as_many_frames_as_asked_for_are_taken(video, tmp_path, notices):
    assert take(video, tmp_path / "out", config=IngestConfig(frames=17))["frames"] == 17
    assert notices() == []


def test_asking_for_more_frames_than_there_are_is_noticed(video, tmp_path, notices):
    assert take(video, tmp_path / "out", config=IngestConfig(frames=50))["frames"] == 40
    assert notices() == ["50 frames were asked for, but the video has 40."]


def test_asking_for_more_frames_than_are_sharp_is_noticed(tmp_path, notices):
    frames = walk(40)
    for index in (5, 11, 17):
        frames[index] = np.full_like(frames[index], frames[index].mean())
    video = write_video(tmp_path / "blurred.mp4", frames)
    config = IngestConfig(frames=40)
    summary = take(video, tmp_path / "out", config=config)
    assert (summary["frames"], summary["dropped_blurred"]) == (37, 3)
    assert len(notices()) == 1
    assert "37 of 40 frames are sharp enough" in notices()[0]
    assert not (tmp_path / "out" / "frames" / "000011.png").exists()


def test_the_automatic_number_stays_under_its_bound(video, tmp_path):
    assert take(video, tmp_path / "out", config=IngestConfig(max_frames=9))["frames"] == 9


@pytest.mark.parametrize(("holdout", "expected"), [
    ("every:8", [0, 8, 16]), ("segment:0.25:0.5", [5, 6, 7, 8, 9]), ("none", [])])
def test_held_out_frames_are_frozen_here(video, tmp_path, holdout, expected):
    take(video, tmp_path / "out", config=IngestConfig(frames=20, holdout=holdout))
    frames = listed(tmp_path / "out")["frames"]
    assert [place for place, frame in enumerate(frames) if frame["held_out"]] == expected


def test_long_frames_are_reduced_with_a_notice(video, tmp_path, notices):
    config = IngestConfig(frames=5, max_size=64)
    summary = take(video, tmp_path / "out", config=config)
    assert (summary["width"], summary["height"]) == (64, 48)
    assert notices() == [
        "Frames of 128x96 are reduced to 64 pixels on the longer side; --max-size changes that."]


def test_the_number_of_threads_changes_nothing(video, tmp_path):
    take(video, tmp_path / "one", threads=1)
    take(video, tmp_path / "four", threads=4)
    assert files(tmp_path / "one") == files(tmp_path / "four")


def test_a_flat_video_passes_for_structure_from_motion_to_judge(tmp_path):
    video = write_video(tmp_path / "flat.mp4", [np.full((96, 128, 3), 128, np.uint8)] * 40)
    assert take(video, tmp_path / "out")["frames"] == 24


# What is damaged


def test_a_video_cut_off_goes_on_with_what_is_left(video, tmp_path, notices):
    data = video.read_bytes()
    video.write_bytes(data[:len(data) // 2])
    summary = take(video, tmp_path / "out")
    assert summary["declared_frames"] == 40
    assert 3 <= summary["decoded_frames"] < 40
    assert summary["lost_frames"] == 40 - summary["decoded_frames"]
    assert len(notices()) == 1
    assert f"{summary['lost_frames']} of 40 frames are lost" in notices()[0]


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
    assert 1 <= summary["lost_frames"] <= 20  # at most the two groups that the hole may touch
    assert summary["decoded_frames"] == 60 - summary["lost_frames"]
    assert f"{summary['lost_frames']} of 60 frames are lost" in notices()[0]
    for frame in listed(tmp_path / "out")["frames"]:
        rgb = store.read_png(tmp_path / "out" / "frames" / frame["name"])
        truth = walk(60)[int(frame["time_seconds"] * 10 + 0.5)].astype(float)
        assert np.abs(rgb - truth).mean() < 12


def test_a_video_that_lost_nearly_all_is_refused(tmp_path):
    video = write_video(tmp_path / "walk.mp4", walk(40))
    data = bytearray(video.read_bytes())
    start = data.index(b"mdat") + 2000
    data[start:] = bytes(len(data) - start)
    video.write_bytes(data)
    with pytest.raises(InputError, match=r"whole frames of 40|No frame"):
        take(video, tmp_path / "out")


def test_a_video_cut_off_before_its_index_is_refused(tmp_path, sample_video):
    data = sample_video.read_bytes()
    (tmp_path / "head.mp4").write_bytes(data[:1000])
    with pytest.raises(InputError, match=r"cannot be read as a video|No frame"):
        take(tmp_path / "head.mp4", tmp_path / "out")


def test_a_video_of_two_frames_is_refused(tmp_path):
    video = write_video(tmp_path / "short.mp4", walk(2))
    with pytest.raises(InputError, match="2 whole frames of 2, but at least 3"):
        take(video, tmp_path / "out")


# What is no capture


def test_a_source_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"room\.mp4 does not exist"):
        take(tmp_path / "room.mp4", tmp_path / "out")


def test_several_sources_are_refused_for_now(video, tmp_path):
    with pytest.raises(InputError, match="2 sources were given, but one is taken for now"):
        take((video, video), tmp_path / "out")


def test_text_named_like_a_video_is_refused(tmp_path):
    (tmp_path / "room.mp4").write_text("this is not a video\n" * 50)
    with pytest.raises(InputError, match="cannot be read as a video"):
        take(tmp_path / "room.mp4", tmp_path / "out")


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "room.mp4").touch()
    with pytest.raises(InputError, match="is empty"):
        take(tmp_path / "room.mp4", tmp_path / "out")


def test_one_photo_is_refused(tmp_path):
    folder = write_photos(tmp_path / "room", 1)
    with pytest.raises(InputError, match="single picture"):
        take(folder / "IMG_0000.jpg", tmp_path / "out")
    with pytest.raises(InputError, match="1 photos"):
        take(folder, tmp_path / "out")


def test_a_folder_without_photos_is_refused(tmp_path):
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "notes.txt").write_text("nothing")
    with pytest.raises(InputError, match="0 photos, 0 more"):
        take(tmp_path / "room", tmp_path / "out")


def test_a_folder_of_unreadable_photos_is_refused(tmp_path):
    (tmp_path / "room").mkdir()
    for index in range(5):
        (tmp_path / "room" / f"{index}.jpg").write_bytes(b"\xff\xd8 broken")
    with pytest.raises(InputError, match=r"5 more.*0\.jpg cannot be read"):
        take(tmp_path / "room", tmp_path / "out")


# Photos


def test_photos_become_frames_that_keep_their_names(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 9, suffix=".png")
    summary = take(folder, tmp_path / "out")
    assert summary == {
        "kind": "photos", "declared_frames": 9, "decoded_frames": 9, "lost_frames": 0,
        "dropped_blurred": 0, "skipped": [], "frames": 9, "held_out": 2, "width": 64,
        "height": 48,
    }
    found = listed(tmp_path / "out")
    assert found["source"] == "photos"
    assert [frame["held_out"] for frame in found["frames"]] == [True] + [False] * 7 + [True]
    for index, frame in enumerate(found["frames"]):
        assert frame["name"] == frame["source"] == f"IMG_{index:04d}.png"
        assert frame["time_seconds"] is frame["sharpness"] is None
        stored = store.read_png(tmp_path / "out" / "frames" / frame["name"])
        np.testing.assert_array_equal(stored, blocks(48, 64, seed=index))
    assert notices() == []


def test_no_metadata_is_carried_over_and_the_focal_length_is_scaled(tmp_path):
    folder = write_photos(tmp_path / "room", 3, size=(80, 60))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26  # FocalLengthIn35mmFilm
    exif[0x010F] = "Secret Camera"
    for path in folder.iterdir():
        Image.open(path).save(path, exif=exif)
    take(folder, tmp_path / "out", config=IngestConfig(max_size=64))
    assert listed(tmp_path / "out")["focal_px"] == pytest.approx(80 * 26 / 43.267)
    for path in (tmp_path / "out" / "frames").iterdir():
        assert b"Secret" not in path.read_bytes()
        assert not Image.open(path).getexif()


def test_half_a_jpeg_among_good_photos_is_left_out_and_named(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 6)
    half = folder / "IMG_0002.jpg"
    half.write_bytes(half.read_bytes()[:half.stat().st_size // 2])
    (folder / "IMG_0007.jpg").write_bytes(b"no photo at all")
    summary = take(folder, tmp_path / "out")
    assert (summary["frames"], summary["lost_frames"]) == (5, 2)
    assert summary["skipped"] == ["IMG_0002.jpg", "IMG_0007.jpg"]
    assert not (tmp_path / "out" / "frames" / "IMG_0002.png").exists()
    assert sum("IMG_0002.jpg" in text for text in notices()) == 1
    assert sum("IMG_0007.jpg" in text for text in notices()) == 1


def test_too_few_photos_that_are_whole_are_refused(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    for path in sorted(folder.iterdir())[:2]:
        path.write_bytes(path.read_bytes()[:path.stat().st_size // 2])
    with pytest.raises(InputError, match="2 photos, 2 more"):
        take(folder, tmp_path / "out")


def test_photos_of_mixed_sizes_are_refused_with_the_sizes(tmp_path):
    folder = write_photos(tmp_path / "room", 4)
    Image.fromarray(blocks(64, 48)).save(folder / "IMG_0009.jpg")
    with pytest.raises(InputError, match="4 of 64x48, 1 of 48x64"):
        take(folder, tmp_path / "out")


# Crashes


@pytest.mark.parametrize("kind", ["video", "photos"])
def test_an_interrupted_run_goes_on_where_it_was_and_ends_the_same(
        video, tmp_path, monkeypatch, kind):
    source = video if kind == "video" else write_photos(tmp_path / "room", 20)
    take(source, tmp_path / "whole")
    written = []
    write = store.write_png

    def interrupted(path, rgb):
        if len(written) == 7:
            raise KeyboardInterrupt
        written.append(path.name)
        write(path, rgb)

    monkeypatch.setattr(store, "write_png", interrupted)
    with pytest.raises(KeyboardInterrupt):
        take(source, tmp_path / "again")
    assert not (tmp_path / "again" / "frames.json").exists()
    frames = tmp_path / "again" / "frames"
    (frames / ".000099.png.tmp1.png").write_bytes(b"left by kill -9")
    before = {path.name: path.stat().st_mtime_ns for path in frames.glob("[!.]*")}
    assert sorted(before) == sorted(written)

    rewritten = []
    monkeypatch.setattr(
        store, "write_png", lambda path, rgb: (rewritten.append(path.name), write(path, rgb)))
    take(source, tmp_path / "again")
    assert files(tmp_path / "again") == files(tmp_path / "whole")
    assert not set(rewritten) & set(written)
    assert {name: (frames / name).stat().st_mtime_ns for name in before} == before


def test_a_second_try_does_not_scan_the_video_again(video, tmp_path, monkeypatch):
    take(video, tmp_path / "out")
    before = files(tmp_path / "out")
    (tmp_path / "out" / "frames.json").unlink()
    monkeypatch.setattr(ingest, "scan_video", None)
    take(video, tmp_path / "out")
    assert files(tmp_path / "out") == before


def test_progress_that_would_survive_a_crash_is_recorded(video, tmp_path):
    seen = []
    out = tmp_path / "out"
    take(video, out, config=IngestConfig(frames=10), record=lambda done, total: seen.append(
        (done, total, len(list((out / "frames").iterdir())))))
    assert seen[-1] == (10, 10, 10)
    assert all(done == stored for done, _, stored in seen)


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
    with pytest.raises(OSError, match="No space left"):
        take(source, tmp_path / "out")
    left = sorted((tmp_path / "out" / "frames").iterdir())
    assert 0 < len(left) <= 3
    for path in left:
        store.read_png(path)
    monkeypatch.setattr(os, "fsync", flush)
    take(source, tmp_path / "out")
    take(source, tmp_path / "undisturbed")
    assert files(tmp_path / "out") == files(tmp_path / "undisturbed")


# Real captures


@pytest.mark.parametrize(("name", "size", "count"), [
    ("video_house_entry/video.mp4", (540, 960), 686),
    ("video_bedroom/room.mp4", (848, 364), 1091),
])
def test_phone_videos_come_out_upright_and_complete(shared_data, tmp_path, name, size, count):
    summary = take(shared_data / name, tmp_path / "out", config=IngestConfig(frames=3))
    assert (summary["width"], summary["height"]) == size
    assert (summary["decoded_frames"], summary["lost_frames"]) == (count, 0)
    assert summary["dropped_blurred"] > 0
