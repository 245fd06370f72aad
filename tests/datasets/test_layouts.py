import json

import posed_sets
import pytest
from app_sets import APPS
from facts import assert_facts, raises

from recon_cli.datasets.layouts import LAYOUTS, describe, read_posed, recognise, refuse_incomplete
from recon_cli.errors import FormatError, InputError


def make_colmap(folder):
    (folder / "sparse").mkdir(parents=True)
    for name, text in (("cameras", "1 SIMPLE_PINHOLE 32 24 30 16 12\n"),
                       ("images", "1 1 0 0 0 0 0 0 1 a.png\n\n"),
                       ("points3D", "1 0 0 5 1 2 3 0.5\n")):
        (folder / "sparse" / f"{name}.txt").write_text(text)
    posed_sets.write_image(folder / "images" / "a.png")
    return folder


MAKERS = {
    "replica": (posed_sets.make_replica, "a Replica sequence (NICE-SLAM layout): 4 frames, 2 with "
                "depth, 2 held-out views"),
    "scannet": (posed_sets.make_scannet, "a ScanNet scene (exported): 3 frames, 3 with depth"),
    "7scenes": (posed_sets.make_seven_scenes, "a 7-Scenes sequence: 3 frames, 3 with depth"),
    "tum": (posed_sets.make_tum, "a TUM RGB-D sequence: 3 frames, 3 with depth"),
    "transforms": (posed_sets.make_transforms,
                   "a transforms.json data set (nerfstudio, instant-ngp): 4 images"),
    "colmap": (make_colmap, "a COLMAP model: 1 image, 1 point"),
}


def test_every_layout_is_tried():
    apps = {app.name for app in APPS.values()}  # tests/datasets/test_apps.py
    assert {layout.name for layout in LAYOUTS} == MAKERS.keys() | apps


@pytest.mark.parametrize("name", MAKERS)
def test_a_layout_is_recognised_read_and_described(tmp_path, name):
    make, words = MAKERS[name]
    make(tmp_path)
    assert recognise(tmp_path) == name
    posed = read_posed(tmp_path)
    assert posed.layout == name
    assert describe(posed) == words


def test_missing_images_are_described(tmp_path):
    posed_sets.make_transforms(tmp_path)
    (tmp_path / "images" / "0000.png").unlink()
    assert_facts(describe(read_posed(tmp_path)), 3, 1, "images", "missing")


def test_recognition_opens_nothing(tmp_path):
    (tmp_path / "transforms.json").write_text("{ broken")
    assert recognise(tmp_path) == "transforms"
    with raises(FormatError, "JSON") as refused:
        read_posed(tmp_path)
    assert_facts(refused.value.hint, "Export", "again")


@pytest.mark.parametrize(("make", "lost", "layout"), [
    (make_colmap, "sparse/cameras.txt", "COLMAP"),
    (posed_sets.make_replica, "traj.txt", "Replica"),
    (posed_sets.make_tum, "groundtruth.txt", "TUM"),
])
def test_a_data_set_that_lost_its_poses_is_not_taken_for_photos(tmp_path, make, lost, layout):
    make(tmp_path)
    refuse_incomplete(tmp_path)
    (tmp_path / lost).unlink()
    with raises(FormatError, layout, lost):
        refuse_incomplete(tmp_path)


def test_frames_of_7_scenes_without_poses_are_not_taken_for_photos(tmp_path):
    posed_sets.make_seven_scenes(tmp_path)
    for path in tmp_path.glob("*.pose.txt"):
        path.unlink()
    with raises(FormatError, "7-Scenes") as refused:
        refuse_incomplete(tmp_path)
    assert "frame-*.color.*" in refused.value.hint


def test_photos_and_videos_have_no_layout(tmp_path):
    posed_sets.write_image(tmp_path / "photo.jpg")
    assert recognise(tmp_path) is None
    assert recognise(tmp_path / "photo.jpg") is None
    assert recognise(tmp_path / "gone") is None
    with raises(InputError, "data", "poses") as caught:
        read_posed(tmp_path)
    assert all(layout.needs in caught.value.hint for layout in LAYOUTS)


def test_what_nerfstudio_made_from_a_colmap_model_is_taken_for_its_own(tmp_path):
    make_colmap(tmp_path)
    posed_sets.make_transforms(tmp_path)
    assert recognise(tmp_path) == "transforms"


def test_a_transforms_file_is_recognised_by_its_name(tmp_path):
    posed_sets.make_transforms(tmp_path)
    assert recognise(tmp_path / "transforms.json") == "transforms"
    (tmp_path / "other.json").write_text(json.dumps(posed_sets.transforms()))
    assert recognise(tmp_path / "other.json") is None


def test_a_folder_where_a_file_belongs_is_a_typed_error(tmp_path):
    posed_sets.make_replica(tmp_path)
    (tmp_path / "results" / "depth000000.png").unlink()
    (tmp_path / "cam_params.json").unlink()
    (tmp_path / "cam_params.json").mkdir()
    with pytest.raises(FormatError):
        read_posed(tmp_path)


@pytest.mark.integration
@pytest.mark.parametrize(("room", "words"), [
    ("rooms/office", "a Replica sequence (NICE-SLAM layout): 100 frames, 20 with depth, "
     "12 held-out views"),
    ("fox", "a transforms.json data set (nerfstudio, instant-ngp): 50 images, 17 images missing"),
    ("desk_monitors", "a COLMAP model: 70 images, 21,444 points")])
def test_real_data_sets_are_described(shared_data, room, words):
    assert describe(read_posed(shared_data / room)) == words
