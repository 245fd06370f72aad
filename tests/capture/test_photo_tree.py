"""Which pictures below a folder are photos, and what is said about the others."""

import json

import numpy as np
import pytest
from facts import assert_facts, raises
from PIL import Image

from recon_cli.capture.photo_tree import describe_unused, find_photo_files
from recon_cli.errors import InputError


def small(*paths):
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(path)


def found(folder, out=None):
    tree = find_photo_files(folder, out)
    return [path.relative_to(folder).as_posix() for path in tree.files], "\n".join(tree.notices)


def test_a_folder_of_photos_is_taken_without_a_word(tmp_path):
    small(tmp_path / "a.png", tmp_path / "b.png")
    (tmp_path / "notes.txt").write_text("none")
    assert found(tmp_path) == (["a.png", "b.png"], "")


def test_photos_in_subfolders_are_used_too_and_said(tmp_path):
    small(tmp_path / "a.png", tmp_path / "more" / "b.png", tmp_path / "more" / "still" / "c.png")
    files, notices = found(tmp_path)
    assert files == ["a.png", "more/b.png", "more/still/c.png"]
    assert_facts(notices, 2, "more/", "more/still/")


def test_photos_several_folders_down_are_found(tmp_path):
    small(tmp_path / "scan" / "2024" / "a.png", tmp_path / "scan" / "masks" / "a.png")
    files, notices = found(tmp_path)
    assert files == ["scan/2024/a.png"]
    assert_facts(notices, "scan/2024/")


def test_several_folders_of_photos_can_all_be_given(tmp_path):
    small(tmp_path / "cam 1" / "a.png", tmp_path / "cam2" / "a.png", tmp_path / "depth" / "a.png")
    with raises(InputError, 2, 1, "cam2") as caught:
        find_photo_files(tmp_path)
    assert f"recon ingest '{tmp_path}/cam 1' {tmp_path}/cam2" in caught.value.hint


def test_among_several_folders_the_one_called_images_is_taken_and_the_others_are_said(tmp_path):
    for name in ("images", "images_2", "renders"):
        small(tmp_path / name / "a.png")
    files, notices = found(tmp_path)
    assert files == ["images/a.png"]
    assert_facts(notices, "images_2/", 1)
    assert f"recon ingest {tmp_path}/renders uses it instead" in notices


def test_a_folder_of_broken_photos_is_not_left_for_another(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    small(tmp_path / "thumbnails" / "a.png")
    assert found(tmp_path)[0] == ["a.jpg"]


@pytest.mark.parametrize(("name", "words"), [
    ("depth", "1 depth maps"), ("confidence", "1 confidence maps"), ("thumbs", "1 small copies"),
    ("operator_masks", "masks are read from"), ("normals", "1 normal maps")])
def test_what_shows_no_colours_is_left_out_and_named(tmp_path, name, words):
    small(tmp_path / "a.png", tmp_path / name / "b.png")
    files, notices = found(tmp_path)
    assert files == ["a.png"]
    assert f"{name}/ holds" in notices
    assert words in notices


def test_folders_of_depth_in_other_formats_are_named_too(tmp_path):
    small(tmp_path / "rgb" / "a.png")
    for name in ("depth/a.exr", "depth/b.exr"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"exr")
    assert_facts(found(tmp_path)[1], "depth/", 2)


def test_masks_in_their_folder_are_no_news(tmp_path):
    small(tmp_path / "a.png", tmp_path / "masks" / "a.png")
    assert found(tmp_path) == (["a.png"], "")


def test_copies_of_the_photos_above_are_left_out(tmp_path):
    small(*(tmp_path / place / f"{name}.png" for place in (".", "small") for name in "abc"))
    files, notices = found(tmp_path)
    assert files == ["a.png", "b.png", "c.png"]
    assert_facts(notices, "small/", 3)


def test_workspaces_and_hidden_folders_hold_no_photos_and_links_are_named(tmp_path):
    photos = tmp_path / "room"
    small(photos / "a.png", photos / ".hidden" / "b.png", tmp_path / "other" / "c.png")
    small(photos / "workspace" / "ingest" / "frames" / "d.png")
    (photos / "workspace" / "ingest" / "manifest.json").write_text("{}")
    small(photos / "new" / "preview of it" / "e.png")
    (photos / "link").symlink_to(tmp_path / "other")
    files, notices = found(photos, photos / "new" / ".partial" / "ingest")
    assert files == ["a.png"]
    assert_facts(notices, "link/", 1, f"recon ingest {photos}/link")


def test_a_link_to_the_only_folder_of_photos_is_followed(tmp_path):
    small(tmp_path / "there" / "a.png")
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "images").symlink_to(tmp_path / "there")
    assert found(tmp_path / "room")[0] == ["images/a.png"]


def test_videos_and_archives_beside_photos_are_named(tmp_path):
    small(tmp_path / "a.png")
    (tmp_path / "walk.mp4").write_bytes(b"")
    (tmp_path / "more.zip").write_bytes(b"PK\x03\x04")
    notices = found(tmp_path)[1]
    assert f"recon ingest {tmp_path} {tmp_path}/walk.mp4 uses both" in notices
    assert "more.zip" in notices


def test_of_an_app_the_best_photos_are_taken_and_its_poses_are_named(tmp_path):
    for name in ("images", "corrected_images"):
        small(tmp_path / "keyframes" / name / "1.jpg")
    small(tmp_path / "thumbnail.jpg")
    for name in ("cameras", "corrected_cameras"):
        (tmp_path / "keyframes" / name).mkdir()
        (tmp_path / "keyframes" / name / "1.json").write_text('{"t_00": 1}')
    files, notices = found(tmp_path)
    assert files == ["keyframes/corrected_images/1.jpg"]
    assert_facts(notices, "keyframes/corrected_cameras/")
    assert_facts(notices, "files", "belong", "missing")
    assert_facts(notices, "poses", "depth")
    inside = found(tmp_path / "keyframes" / "images")[1]
    assert f"recon ingest {tmp_path / 'keyframes'} uses them" in inside


def test_poses_above_a_folder_called_images_are_named_too(tmp_path):
    small(tmp_path / "rgb" / "0.jpg")
    (tmp_path / "metadata.json").write_text(json.dumps({"poses": [], "K": []}))
    assert_facts(found(tmp_path / "rgb")[1], "Record3D")
    assert_facts(found(tmp_path)[1], "Record3D")


def test_the_icon_of_a_recording_is_not_a_photo_of_it(tmp_path):
    small(tmp_path / "rgbd" / "0.jpg", tmp_path / "icon.png")
    (tmp_path / "icon.png").rename(tmp_path / "icon")
    (tmp_path / "metadata").write_text(json.dumps({"poses": [], "K": []}))
    assert found(tmp_path)[0] == ["rgbd/0.jpg"]


def test_depth_and_poses_that_a_data_set_does_not_use_are_named(tmp_path):
    for name in ("depth", "confidence", "images", "masks"):
        small(tmp_path / name / "a.png")
    np.save(tmp_path / "poses_bounds.npy", np.zeros(3))
    (tmp_path / "bundle.out").write_text("# Bundle file v0.3\n")
    used = {tmp_path / "images" / "a.png", tmp_path / "depth" / "a.png"}
    maps, cameras = describe_unused(tmp_path, used, "colmap", "a COLMAP model")
    assert_facts(maps, "confidence/", 1)
    assert_facts(cameras, "bundle.out", "Bundler", "COLMAP")
    assert len(describe_unused(tmp_path, used, "bundler", "that")) == 1
