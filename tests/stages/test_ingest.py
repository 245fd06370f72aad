import json
import logging
from fractions import Fraction

import cv2
import media
import numpy as np
import pytest
from facts import assert_facts, raises
from ingest_media import (
    blocks,
    files,
    listed,
    take,
    walk,
    write_photos,
    write_sequence,
    write_video,
)
from PIL import Image

from recon_cli.capture import from_photos, from_video
from recon_cli.config.stages import IngestConfig
from recon_cli.errors import InputError
from recon_cli.io import images
from recon_cli.io.tracks import TRACKS, Tracks
from recon_cli.stages import ingest


@pytest.fixture
def video(tmp_path):
    return write_video(tmp_path / "walk.mp4", walk(40))


@pytest.fixture
def notices(caplog):
    caplog.set_level(logging.WARNING, logger="recon")
    return lambda: [record.getMessage() for record in caplog.records]


@pytest.mark.integration
def test_a_video_becomes_sharp_frames_and_a_list_of_them(video, tmp_path, notices):
    summary = take(video, tmp_path / "out")
    found = listed(tmp_path / "out")
    names = [frame["name"] for frame in found["frames"]]
    assert summary.to_json() == {
        "kind": "video", "declared_frames": 40, "decoded_frames": 40, "lost_frames": 0,
        "dropped_blurred": 0, "skipped": [], "frames": len(names), "held_out": -(-len(names) // 8),
        "groups": 1, "width": 128, "height": 96,
    }
    assert found["source"] == "video"
    assert found["groups"] == [
        {"name": "walk.mp4", "width": 128, "height": 96, "focal_px": None, "lens": None}]
    assert names == sorted(names)
    assert names == sorted(path.name for path in (tmp_path / "out" / "frames").iterdir())
    for place, frame in enumerate(found["frames"]):
        index = int(frame["name"].removesuffix(".png"))
        assert frame["time_seconds"] == pytest.approx(index / 10)
        assert frame["source"] == "walk.mp4"
        assert frame["sharpness"] > 0
        assert frame["held_out"] == (place % 8 == 0)
        rgb = images.read_png(tmp_path / "out" / "frames" / frame["name"])
        truth = walk(40)[index].astype(float)
        # Half of the colour resolution is lost in the video, and interpolated over the edges of the
        # blocks; the wrong frame is off by 50.
        assert np.abs(rgb - truth).mean() < 20
    assert notices() == []


@pytest.mark.integration
def test_the_bundled_video_gives_a_number_that_structure_from_motion_likes(sample_video, tmp_path):
    summary = take(sample_video, tmp_path / "out")
    assert 60 <= summary.frames <= 100
    assert (summary.width, summary.height, summary.lost_frames) == (600, 340, 0)


@pytest.mark.integration
def test_as_many_frames_as_asked_for_are_taken(video, tmp_path, notices):
    assert take(video, tmp_path / "out", config=IngestConfig(frames=17)).frames == 17
    assert notices() == []


@pytest.mark.integration
def test_asking_for_more_frames_than_there_are_is_noticed(video, tmp_path, notices):
    assert take(video, tmp_path / "out", config=IngestConfig(frames=50)).frames == 40
    (notice,) = notices()
    assert_facts(notice, 50, "walk.mp4", 40)


@pytest.mark.integration
def test_asking_for_more_frames_than_are_sharp_is_noticed(tmp_path, notices):
    frames = walk(40)
    for index in (5, 11, 17):
        frames[index] = np.full_like(frames[index], frames[index].mean())
    video = write_video(tmp_path / "blurred.mp4", frames)
    config = IngestConfig(frames=40)
    summary = take(video, tmp_path / "out", config=config)
    assert (summary.frames, summary.dropped_blurred) == (37, 3)
    assert len(notices()) == 1
    assert_facts(notices()[0], 37, 40, "frames", "enough")
    assert not (tmp_path / "out" / "frames" / "000011.png").exists()


@pytest.mark.integration
@pytest.mark.parametrize("frames", [None, 12, 30])
def test_of_repeated_pictures_of_a_video_one_is_taken(tmp_path, notices, frames):
    views = walk(15)
    video = write_video(tmp_path / "screen.mp4", [views[index // 4] for index in range(60)])
    summary = take(video, tmp_path / "out", config=IngestConfig(frames=frames))
    pictures = [int(path.stem) // 4 for path in sorted((tmp_path / "out" / "frames").iterdir())]
    assert pictures == sorted(set(pictures))
    assert summary.frames == len(pictures) == min(frames or 15, 15)
    assert summary.dropped_blurred == 0
    record = json.loads((tmp_path / "out" / "choice.json").read_text())["candidates"]
    for one in record:
        if one["reason"] == "duplicate":
            assert one["like"] // 4 == one["index"] // 4
    assert len(notices()) == (frames == 30)
    for notice in notices():
        assert_facts(notice, "15 of 60", "repeat")


@pytest.mark.integration
def test_a_slide_show_of_two_pictures_is_refused(tmp_path):
    views = walk(9)
    video = write_video(tmp_path / "slides.mp4", [views[8 * (index // 20)] for index in range(40)])
    with raises(InputError, 2, 40, "different"):
        take(video, tmp_path / "out")


@pytest.mark.integration
def test_the_automatic_number_stays_under_its_bound(video, tmp_path):
    assert take(video, tmp_path / "out", config=IngestConfig(max_frames=9)).frames == 9


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["video", "photos"])
def test_what_was_kept_and_dropped_is_recorded_and_drawn(video, tmp_path, kind):
    source = video if kind == "video" else write_photos(tmp_path / "room", 6)
    take(source, tmp_path / "out", config=IngestConfig(max_frames=9))
    record = json.loads((tmp_path / "out" / "choice.json").read_text())
    kept = [one["name"] for one in record["candidates"] if one["reason"] == "kept"]
    assert kept == [frame["name"] for frame in listed(tmp_path / "out")["frames"]]
    assert len(record["candidates"]) == (40 if kind == "video" else 6)
    assert Image.open(tmp_path / "out" / "contact.png").size[0] > 400


def test_photos_of_the_same_view_are_left_out_and_named(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 6)
    (folder / "IMG_0007.jpg").write_bytes((folder / "IMG_0002.jpg").read_bytes())
    summary = take(folder, tmp_path / "out")
    assert (summary.frames, summary.skipped) == (6, ("IMG_0007.jpg",))
    assert not (tmp_path / "out" / "frames" / "IMG_0007.png").exists()
    notice, = notices()
    assert_facts(notice, 1, "IMG_0007.jpg", "IMG_0002.jpg")
    before = files(tmp_path / "out")
    take(folder, tmp_path / "out")
    assert files(tmp_path / "out") == before


@pytest.mark.integration
@pytest.mark.parametrize(("holdout", "expected"), [
    ("every:8", [0, 8, 16]), ("segment:0.25:0.5", [5, 6, 7, 8, 9]), ("none", [])])
def test_held_out_frames_are_frozen_here(video, tmp_path, holdout, expected):
    take(video, tmp_path / "out", config=IngestConfig(frames=20, holdout=holdout))
    frames = listed(tmp_path / "out")["frames"]
    assert [place for place, frame in enumerate(frames) if frame["held_out"]] == expected


@pytest.mark.integration
def test_long_frames_are_reduced_with_a_notice(video, tmp_path, notices):
    config = IngestConfig(frames=5, max_size=64)
    summary = take(video, tmp_path / "out", config=config)
    assert (summary.width, summary.height) == (64, 48)
    notice, = notices()
    assert_facts(notice, "128x96", 64, "--max-size")


@pytest.mark.integration
def test_the_number_of_threads_changes_nothing(video, tmp_path):
    take(video, tmp_path / "one", threads=1)
    take(video, tmp_path / "four", threads=4)
    assert files(tmp_path / "one") == files(tmp_path / "four")


@pytest.mark.integration
def test_several_sources_are_kept_apart_and_share_the_budget(video, tmp_path):
    other = write_video(tmp_path / "slow.mp4", walk(40, step=2, height=64))
    folder = write_photos(tmp_path / "room", 4)
    config = IngestConfig(frames=30, holdout="every:4")
    summary = take((video, folder, other), tmp_path / "out", config=config)
    assert (summary.kind, summary.groups, summary.frames) == ("mixed", 3, 34)
    assert (summary.width, summary.height) == (128, 96)
    found = listed(tmp_path / "out")
    assert [(group["name"], group["width"], group["height"]) for group in found["groups"]] == [
        ("walk.mp4", 128, 96), ("room", 64, 48), ("slow.mp4", 128, 64)]
    names = [frame["name"] for frame in found["frames"]]
    assert names == sorted(names)
    by_group = [[n for n, f in zip(names, found["frames"], strict=True) if f["group"] == group]
                for group in range(3)]
    assert [len(group) for group in by_group] == [20, 4, 10]  # one video walks twice as far
    assert [{name[:3] for name in group} for group in by_group] == [{"01_"}, {"02_"}, {"03_"}]
    assert [place for place, frame in enumerate(found["frames"]) if frame["held_out"]] == list(
        range(0, 34, 4))


# Photos


def test_photos_become_frames_that_keep_their_names(tmp_path, notices):
    folder = write_photos(tmp_path / "room", 9, suffix=".png")
    summary = take(folder, tmp_path / "out")
    assert summary.to_json() == {
        "kind": "photos", "declared_frames": 9, "decoded_frames": 9, "lost_frames": 0,
        "dropped_blurred": 0, "skipped": [], "frames": 9, "held_out": 2, "groups": 1,
        "width": 64, "height": 48,
    }
    found = listed(tmp_path / "out")
    assert found["source"] == "photos"
    assert [frame["held_out"] for frame in found["frames"]] == [True] + [False] * 7 + [True]
    for index, frame in enumerate(found["frames"]):
        assert frame["name"] == frame["source"] == f"IMG_{index:04d}.png"
        assert frame["time_seconds"] is frame["sharpness"] is None
        stored = images.read_png(tmp_path / "out" / "frames" / frame["name"])
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
    assert listed(tmp_path / "out")["groups"][0]["focal_px"] == pytest.approx(80 * 26 / 43.267)
    for path in (tmp_path / "out" / "frames").iterdir():
        assert b"Secret" not in path.read_bytes()
        assert not Image.open(path).getexif()



@pytest.mark.integration
@pytest.mark.parametrize(("milliseconds", "count"), [(100, 100), (500, 110)])
def test_photos_of_a_walk_that_were_taken_two_a_second_are_all_kept(
        tmp_path, milliseconds, count):
    folder = write_sequence(tmp_path / "room", 110)
    for index, path in enumerate(sorted(folder.iterdir())):
        seconds, part = divmod(milliseconds * index, 1000)
        path.rename(folder / f"20240212_1000{seconds:02d}_{part:03d}.jpg")
    take(folder, tmp_path / "out")
    assert len(listed(tmp_path / "out")["frames"]) == count
    assert (tmp_path / "out" / TRACKS).exists()

# Crashes


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["video", "photos", "sequence"])
def test_an_interrupted_run_goes_on_where_it_was_and_ends_the_same(
        video, tmp_path, monkeypatch, kind):
    source = {
        "video": lambda: video, "photos": lambda: write_photos(tmp_path / "room", 20),
        "sequence": lambda: write_sequence(tmp_path / "room", 110)}[kind]()
    take(source, tmp_path / "whole")
    written = []
    write = images.write_png

    def interrupted(path, rgb):
        if len(written) == 7:
            raise KeyboardInterrupt
        written.append(path.name)
        write(path, rgb)

    for module in (from_photos, from_video):
        monkeypatch.setattr(module, "write_png", interrupted)
    with pytest.raises(KeyboardInterrupt):
        take(source, tmp_path / "again")
    assert not (tmp_path / "again" / "frames.json").exists()
    frames = tmp_path / "again" / "frames"
    (frames / ".000099.png.tmp1.png").write_bytes(b"left by kill -9")
    before = {path.name: path.stat().st_mtime_ns for path in frames.glob("[!.]*")}
    assert sorted(before) == sorted(written)

    rewritten = []
    for module in (from_photos, from_video):
        monkeypatch.setattr(
            module, "write_png", lambda path, rgb: (rewritten.append(path.name), write(path, rgb)))
    take(source, tmp_path / "again")
    assert files(tmp_path / "again") == files(tmp_path / "whole")
    assert not set(rewritten) & set(written)
    assert {name: (frames / name).stat().st_mtime_ns for name in before} == before


@pytest.mark.integration
def test_a_second_try_does_not_scan_the_video_again(video, tmp_path, monkeypatch):
    take(video, tmp_path / "out")
    before = files(tmp_path / "out")
    (tmp_path / "out" / "frames.json").unlink()
    monkeypatch.setattr(from_video, "scan_video", None)
    take(video, tmp_path / "out")
    assert files(tmp_path / "out") == before


# Overlays


def marked_walk(frames=60):
    """A walk with a grid of crosses in every frame, which holds most of its corners."""
    marked = [frame.copy() for frame in walk(frames, step=12, height=180, width=320)]
    for frame in marked:
        for x in range(20, 300, 40):
            cv2.drawMarker(frame, (x, 160), (255, 255, 255), cv2.MARKER_CROSS, 14, 5)
            cv2.drawMarker(frame, (x, 160), (0, 0, 0), cv2.MARKER_CROSS, 12, 3)
    return marked


@pytest.fixture
def marked(tmp_path):
    return write_video(tmp_path / "marked.mp4", marked_walk())


@pytest.mark.integration
def test_an_overlay_is_masked_in_every_frame_and_drawn_and_told(marked, tmp_path, notices):
    take(marked, tmp_path / "out")
    frames = listed(tmp_path / "out")["frames"]
    assert all(frame["masked"] for frame in frames)
    masks = {path.name: images.read_mask(path, 320, 180)
             for path in (tmp_path / "out" / "masks").iterdir()}
    assert set(masks) == {frame["name"] for frame in frames}
    mask = masks[frames[0]["name"]]
    assert all((other == mask).all() for other in masks.values())
    assert not mask[157:164, 20:261:40].any()
    assert mask[:135].all()
    picture = images.read_png(tmp_path / "out" / "overlay.png").astype(int)
    assert picture[~mask][:, 0].min() >= 127
    tracks = Tracks.read(tmp_path / "out" / "tracks.safetensors")
    x, y = (tracks.xy * (320, 180)).astype(int).T
    assert len(x) > 100
    assert mask[y, x].mean() > .99  # the mask is rounded to pixels
    assert sum("overlay (text" in notice and "overlay.png" in notice
               for notice in notices()) == 1


@pytest.mark.integration
def test_an_overlay_is_kept_on_request(marked, tmp_path, notices):
    take(marked, tmp_path / "out", config=IngestConfig(overlays="keep"))
    assert not any(frame["masked"] for frame in listed(tmp_path / "out")["frames"])
    assert not (tmp_path / "out" / "masks").exists()
    assert not any("fixed" in notice for notice in notices())


def round_pictures(frames):
    """Frames as a fisheye shows them: a disk, and black around it."""
    height, width = frames[0].shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    disk = (np.hypot(x, y) < 0.48 * height)[..., None]
    return [frame * disk for frame in frames]


@pytest.mark.integration
def test_the_border_of_a_fisheye_video_is_masked_or_kept_on_request(tmp_path, notices):
    video = write_video(
        tmp_path / "round.mp4", round_pictures(walk(40, step=6, height=180, width=320)))
    take(video, tmp_path / "out")
    frames = listed(tmp_path / "out")["frames"]
    assert all(frame["masked"] for frame in frames)
    for frame in frames:
        mask = images.read_mask(tmp_path / "out" / "masks" / frame["name"], 320, 180)
        assert 0.25 < mask.mean() < np.pi * (0.48 * 180) ** 2 / 320 / 180
        assert mask[90, 100:220].all()
    tracks = Tracks.read(tmp_path / "out" / "tracks.safetensors")
    away = np.linalg.norm((tracks.xy - 0.5) * (320, 180), axis=1)
    assert len(away) > 100
    assert away.max() < 0.48 * 180
    assert_facts("\n".join(notices()), "round", "picture", "fisheye")
    take(video, tmp_path / "kept", config=IngestConfig(overlays="keep"))
    assert not any(frame["masked"] for frame in listed(tmp_path / "kept")["frames"])


@pytest.mark.integration
def test_a_walk_without_an_overlay_gets_no_mask(tmp_path):
    video = write_video(tmp_path / "walk.mp4", walk(60, step=12, height=180, width=320))
    take(video, tmp_path / "out")
    assert not any(frame["masked"] for frame in listed(tmp_path / "out")["frames"])
    assert not (tmp_path / "out" / "overlay.png").exists()


@pytest.mark.integration
def test_a_second_try_finds_the_overlay_of_the_first_scan(marked, tmp_path, monkeypatch, notices):
    take(marked, tmp_path / "out")
    before = files(tmp_path / "out")
    for name in ("frames.json", "overlay.png"):
        (tmp_path / "out" / name).unlink()
    (tmp_path / "out" / "masks" / listed_names(before)[0]).unlink()
    for name in ("scan_video", "measure_scene"):
        monkeypatch.setattr(from_video, name, None)
    take(marked, tmp_path / "out")
    assert files(tmp_path / "out") == before
    assert len(set(notices())) * 2 == len(notices())


def listed_names(written):
    return sorted(name.removeprefix("masks/") for name in written if name.startswith("masks/"))


@pytest.mark.integration
def test_what_covers_too_much_of_the_picture_is_not_masked(marked, tmp_path, monkeypatch, notices):
    monkeypatch.setattr(from_video, "MOST", 0.01)
    take(marked, tmp_path / "out")
    assert not any(frame["masked"] for frame in listed(tmp_path / "out")["frames"])
    assert_facts("\n".join(notices()), "masked")


@pytest.mark.integration
def test_progress_that_would_survive_a_crash_is_recorded(video, tmp_path):
    seen = []
    out = tmp_path / "out"
    take(video, out, config=IngestConfig(frames=10), record=lambda done, total: seen.append(
        (done, total, len(list((out / "frames").glob("*.png"))))))
    assert seen[-1] == (10, 10, 10)
    assert [done for done, _, _ in seen] == list(range(1, 11))
    assert all(done <= stored for done, _, stored in seen)

# Real captures


@pytest.mark.integration
@pytest.mark.parametrize(("name", "size", "count"), [
    ("video_house_entry/video.mp4", (540, 960), 686),
    ("video_bedroom/room.mp4", (848, 364), 1091),
])
def test_phone_videos_come_out_upright_and_complete(shared_data, tmp_path, name, size, count):
    summary = take(shared_data / name, tmp_path / "out", config=IngestConfig(frames=3))
    assert (summary.width, summary.height) == size
    assert (summary.decoded_frames, summary.lost_frames) == (count, 0)
    assert summary.dropped_blurred > 0


@pytest.mark.integration
def test_what_was_done_to_a_video_is_said_once_for_each_thing(tmp_path, notices):
    path = media.write_video(tmp_path / "wide.mp4", walk(40), aspect=Fraction(4, 3))
    summary = take(path, tmp_path / "out")
    assert (summary.width, summary.height) == (171, 96)
    (notice,) = notices()
    assert_facts(notice, "wide.mp4", "4/3", "128x96", "171x96")


@pytest.mark.integration
def test_many_frames_are_told_in_advance(
    video, tmp_path, notices, monkeypatch
):
    take(video, tmp_path / "few")
    assert not any("--max-frames" in notice for notice in notices())
    monkeypatch.setattr(ingest, "FEW_FRAMES", 10)
    summary = take(video, tmp_path / "many")
    notice, = (notice for notice in notices() if "--max-frames" in notice)
    assert_facts(notice, summary.frames)
