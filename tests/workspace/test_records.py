import json

import cv2
import numpy as np
import pytest
from facts import assert_facts, raises
from media import texture

from recon_cli.config.stages import parse_holdout
from recon_cli.errors import FormatError
from recon_cli.io.images import fit_image, read_png, write_png
from recon_cli.scene.camera import Lens
from recon_cli.workspace.records import (
    Frame,
    FrameList,
    Group,
    KnownPoses,
    choose_held_out,
    describe_stretches,
    name_photos,
    prepare_frames_folder,
    read_frame_list,
    read_poses,
)

NAMES = [f"{index:06d}.png" for index in range(20)]


@pytest.mark.parametrize(("holdout", "indices"), [
    ("every:8", [0, 8, 16]),
    ("every:7", [0, 7, 14]),
    ("segment:0.5:0.75", [10, 11, 12, 13, 14]),
    ("segment:0:1", list(range(20))),
    ("none", []),
])
def test_held_out_frames_go_by_sorted_name(holdout, indices):
    held = choose_held_out(NAMES[::-1], parse_holdout(holdout))
    assert held == {NAMES[index] for index in indices}


def test_a_frame_list_comes_back_as_it_was_written(tmp_path):
    frames = (
        Frame("000003.png", 0.3, "room.mp4", 12.5, True),
        Frame("000009.png", None, "b.jpg", None, False, group=1, masked=True),
    )
    lens = Lens("RADIAL", 80, 60, (70.0, 40.0, 30.0, 0.1, -0.2))
    groups = (Group("room.mp4", 64, 48, focal_px=50.0), Group("photos", 80, 60, lens=lens))
    written = FrameList("mixed", groups, frames)
    written.write(tmp_path)
    assert read_frame_list(tmp_path) == written


@pytest.mark.parametrize("text", ["[]", "{}", '{"frames": [{"name": "a.png"}]}', "{"])
def test_a_file_that_is_no_frame_list_is_refused(tmp_path, text):
    (tmp_path / "frames.json").write_text(text)
    with pytest.raises(FormatError):
        read_frame_list(tmp_path)


FRAME = {"name": "a.png", "time_seconds": None, "source": "a.jpg", "sharpness": None,
         "held_out": False, "group": 0, "masked": False}
GROUP = {"name": "room", "width": 8, "height": 6, "focal_px": None, "lens": None}


def write_list(folder, frame=FRAME, group=GROUP, **more):
    (folder / "frames.json").write_text(json.dumps(
        {"source": "photos", "frames": [frame], "groups": [group], **more}))


@pytest.mark.parametrize("frame", [
    {"name": 5}, {"name": "../a.png"}, {"name": "/etc/passwd"}, {"name": None}, {"group": 1},
    {"group": -1}, {"group": "x"}, {"held_out": "no"}, {"sharpness": []}, {"source": {}}])
def test_a_frame_of_other_types_or_elsewhere_is_refused(tmp_path, frame):
    write_list(tmp_path)
    assert read_frame_list(tmp_path).frames[0].name == "a.png"
    write_list(tmp_path, FRAME | frame)
    with raises(FormatError, "frames.json") as caught:
        read_frame_list(tmp_path)
    assert caught.value.hint


@pytest.mark.parametrize("group", [
    {"width": "x"}, {"lens": 5}, {"lens": {"model": "PINHOLE"}},
    {"lens": {"model": "NONE", "width": 8, "height": 6, "params": [1]}},
    {"lens": {"model": "PINHOLE", "width": 8, "height": 6, "params": [float("nan")] * 4}},
    {"lens": {"model": "PINHOLE", "width": 8, "height": 6, "params": ["x"] * 4}},
    {"lens": {"model": [], "width": 8, "height": 6, "params": [1, 1, 1, 1]}}])
def test_a_group_that_is_none_is_refused(tmp_path, group):
    write_list(tmp_path, group=GROUP | group)
    with raises(FormatError, "frames.json"):
        read_frame_list(tmp_path)


def test_a_list_without_groups_or_with_foreign_fields_is_judged_by_what_is_needed(tmp_path):
    write_list(tmp_path, FRAME | {"colour": "red"}, foreign=[[]])
    assert len(read_frame_list(tmp_path).frames) == 1
    write_list(tmp_path, groups=[])
    with pytest.raises(FormatError):
        read_frame_list(tmp_path)


def test_poses_that_are_not_finite_are_refused(tmp_path):
    pose = np.eye(4)
    KnownPoses({"a.png": pose}, metric=False).write(tmp_path)
    np.testing.assert_array_equal(read_poses(tmp_path / "poses.json").viewmats["a.png"], pose)
    text = (tmp_path / "poses.json").read_text()
    for junk in ("NaN", "1" * 400, '"x"', "[]"):
        (tmp_path / "poses.json").write_text(text.replace("1.0", junk, 1))
        with raises(FormatError, "poses.json"):
            read_poses(tmp_path / "poses.json")


def test_frames_are_stored_without_loss_as_rgb(tmp_path):
    rgb = texture(48, 64)
    write_png(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), rgb)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[:, :, ::-1], rgb)


@pytest.mark.parametrize("content", [b"", b"\x89PNG"])
def test_a_broken_frame_is_no_picture(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    with raises(FormatError, tmp_path / "a.png"):
        read_png(tmp_path / "a.png")


def test_large_frames_are_reduced_by_area():
    rgb = texture(40, 60, coarseness=1)
    assert fit_image(rgb, 60) is rgb
    halved = fit_image(rgb, 30)
    mean = rgb.reshape(20, 2, 30, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(halved, mean, atol=0.5)  # rounding to 8 bits
    assert fit_image(rgb.transpose(1, 0, 2), 30).shape == (30, 20, 3)


def test_leftovers_of_a_killed_run_are_cleared_and_frames_are_kept(tmp_path):
    folder = prepare_frames_folder(tmp_path)
    (folder / "000001.png").write_bytes(b"kept")
    (folder / ".000002.png.tmp123.png").write_bytes(b"half")
    (tmp_path / ".frames.json.tmp123.json").write_bytes(b"half")
    assert prepare_frames_folder(tmp_path) == folder
    assert [path.name for path in tmp_path.rglob("*")] == ["frames", "000001.png"]


def test_stretches_end_where_a_frame_is_not_named_or_its_video_ends():
    def frame(name, seconds, source="a.mp4"):
        return Frame(name, seconds, source, None, held_out=False)

    first = [frame(f"{i}.png", i / 2) for i in range(5)]
    assert describe_stretches(first, ["1.png", "2.png", "4.png", "gone.png"]) == [
        "1.png to 2.png (0.5 to 1.0 s)", "4.png (2.0 s)"]
    both = [*first, frame("5.png", 0.0, "b.mp4"), frame("6.png", 0.5, "b.mp4")]
    assert describe_stretches(both, ["4.png", "5.png", "6.png"]) == [
        "4.png (2.0 s of a.mp4)", "5.png to 6.png (0.0 to 0.5 s of b.mp4)"]
    photos = [frame(f"{i}.png", None, f"{i}.jpg") for i in range(3)]
    assert describe_stretches(photos, ["1.png", "2.png"]) == ["1.png to 2.png"]
    assert describe_stretches(photos, []) == []


def write_photos(folder):
    """Photos 2.jpg to 10.jpg, two of one name, one called as a frame is, and a video's frame."""
    photos = [("000000.png", "2.jpg"), ("000001.png", "10.jpg"), ("000002.png", "000001.png"),
              ("000003.png", "twice.jpg"), ("000004.png", "twice.jpg")]
    frames = [Frame(name, None, source, None, held_out=False) for name, source in photos]
    frames.append(Frame("000005.png", 1.5, "walk.mp4", None, held_out=False))
    FrameList("mixed", (Group("room", 60, 40),), tuple(frames)).write(folder)


def test_photos_in_a_text_are_named_by_their_own_files(tmp_path):
    write_photos(tmp_path)
    name = name_photos(tmp_path)
    assert name("000000.png and 000001.png.") == "2.jpg and 10.jpg."
    assert name("(000002.png)") == "(000001.png)", "once: not as the frame of that name"
    same = "000003.png, 000005.png (1.5 s), x000000.png, ingest/frames/000000.png, 000000.png.tmp"
    assert_facts(
        name(same), "000003.png", "000005.png", "1.5", "x000000.png", "ingest/frames/000000.png")
    assert name_photos(tmp_path / "none")(same) == same


def test_a_photo_is_found_by_its_own_name_alone_or_with_a_pixel(tmp_path):
    write_photos(tmp_path)
    words = ["2.jpg", "10.jpg:4,5", "000005.png", "test", "0,1,2"]
    assert read_frame_list(tmp_path).find(words) == (
        "000000.png", "000001.png:4,5", "000005.png", "test", "0,1,2")
