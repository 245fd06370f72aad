"""Poses and depth of other programs are recognised by the files that those write."""

import json
import sqlite3

import numpy as np
import pytest
from facts import assert_facts

from recon_cli.capture.known_files import (
    KNOWN_FILES,
    find_foreign,
    find_lists,
    picture_kind,
    recognise_file,
)
from recon_cli.datasets.layouts import LAYOUTS

METASHAPE = ('<?xml version="1.0"?><document version="2.0.0"><chunk><cameras>'
             '<camera id="0" label="a"/></cameras></chunk></document>')
REALITY = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\na.jpg,0,0,0,0,0,0,18\n"
RECORD3D = json.dumps({"frameTimestamps": [0.5] * 4000, "K": [1] * 9, "poses": [[0] * 7]})
FILES = {
    "keyframes/cameras/1.json": ('{"t_00": 1, "fx": 3}', "Polycam"),
    "metadata.json": (RECORD3D, "Record3D"),
    "metadata": (RECORD3D, "Record3D"),
    "odometry.csv": ("timestamp, frame, x, y, z, qx, qy, qz, qw\n", "Stray Scanner"),
    "frame_00001.json": ('{"cameraPoseARFrame": [1]}', "3D Scanner App"),
    "lowres_wide.traj": ("0 0 0 0 0 0 0\n", "ARKitScenes"),
    "rtabmap_camera_poses.txt": ("#timestamp x y z qx qy qz qw id\n", "RTAB-Map"),
    "left_camera_mruk_intrinsics.json": ("{}", "Quest"),
    "cameras.xml": (METASHAPE, "Metashape"),
    "cams.csv": (REALITY, "RealityScan"),
    "a.xmp": ("<xcr:Rotation>1 0 0</xcr:Rotation>", "RealityScan"),
    "blocks.xml": ("<BlocksExchange version='2.1'/>", "ContextCapture"),
    "bundle.out": ("# Bundle file v0.3\n0 0\n", "Bundler"),
    "reconstruction.json": ('[{"shots": {}}]', "OpenSfM"),
    "odm_report/shots.geojson": ("{}", "OpenDroneMap"),
    "cameras.sfm": ('{"views": [], "poses": []}', "Meshroom"),
    "sfm_data.json": ('{"views": [], "extrinsics": []}', "OpenMVG"),
    "scene.nvm": ("NVM_V3\n", "VisualSFM"),
    "p_calibrated_external_camera_parameters.txt": ("", "Pix4D"),
    "cams/00000000_cam.txt": ("extrinsic\n", "MVSNet"),
    "cameras.json": ("[]", "camera poses, by its name"),
    "frames.json": ('{"frames": [{"transform_matrix": []}]}', "transforms.json"),
    "trajectory.txt": ("0 0 0\n", "camera poses, by its name"),
    "dense/0/cameras.bin": ("", "COLMAP"),
}


def put(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize("name", FILES)
def test_what_a_program_leaves_is_recognised_and_named(tmp_path, name):
    text, words = FILES[name]
    put(tmp_path / name, text)
    (found,) = find_foreign(tmp_path)
    assert words in found.row.words
    assert words in found.notice(tmp_path)
    assert found.row.carries in found.notice(tmp_path)


def test_files_without_text_are_recognised_too(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((2, 17)))
    with sqlite3.connect(tmp_path / "walk.db") as database:
        database.execute("CREATE TABLE Node (id INTEGER)")
        database.execute("CREATE TABLE Link (id INTEGER)")
    database.close()
    for found, name in zip(find_foreign(tmp_path), ("RTAB-Map", "LLFF"), strict=True):
        assert_facts(found.row.words, name)


def test_the_command_that_converts_it_names_its_file(tmp_path):
    put(tmp_path / "sfm_data.json", '{"views": [], "extrinsics": []}')
    (found,) = find_foreign(tmp_path)
    assert (f"openMVG_main_openMVG2Colmap -i {tmp_path / 'sfm_data.json'} -o SCENE"
            ) in found.notice(tmp_path)


def test_what_is_read_as_a_data_set_names_the_folder_to_give(tmp_path):
    put(tmp_path / "odometry.csv", FILES["odometry.csv"][0])
    (found,) = find_foreign(tmp_path)
    assert f"recon ingest {tmp_path} uses them" in found.notice(tmp_path / "rgb.mp4")
    assert_facts(found.notice(tmp_path), "files", "belong", "missing")


def test_every_layout_that_a_row_names_is_read():
    assert {row.layout for row in KNOWN_FILES} - {""} <= {row.name for row in LAYOUTS}


@pytest.mark.parametrize(("name", "text"), [
    ("notes.xml", "<notes/>"), ("prices.csv", "name,price\n"), ("metadata.json", '{"K": 1}'),
    ("report.json", "{}"), ("readme.txt", "hello")])
def test_other_files_are_not_taken_for_poses(tmp_path, name, text):
    put(tmp_path / name, text)
    assert find_foreign(tmp_path) == []
    assert recognise_file(tmp_path / name) is None


def test_hidden_files_are_not_looked_at(tmp_path):
    put(tmp_path / ".hidden.nvm", "NVM_V3")
    assert find_foreign(tmp_path) == []


def test_a_file_is_recognised_by_itself(tmp_path):
    put(tmp_path / "any.xml", METASHAPE)
    put(tmp_path / "cameras.json", "[]")
    put(tmp_path / "odometry walk.mp4", "")
    found = [recognise_file(path) for path in sorted(tmp_path.iterdir())]
    for one, name in zip(found, ("Metashape", "poses"), strict=False):
        assert name in one.row.words
    assert found[2] is None


def test_a_text_that_lists_the_pictures_is_found_whoever_wrote_it(tmp_path):
    names = [f"IMG_{index}.jpg" for index in range(6)]
    put(tmp_path / "angles.txt", "".join(f"{name} 1.5 2.5\n" for name in names[:4]))
    put(tmp_path / "best.txt", names[0])
    assert find_lists(tmp_path, names, known=()) == [tmp_path / "angles.txt"]
    assert find_lists(tmp_path, names, known=[tmp_path / "angles.txt"]) == []


def test_every_row_says_what_is_lost():
    assert all(row.words and row.carries and (row.patterns or row.lost) for row in KNOWN_FILES)
    assert len({row.words for row in KNOWN_FILES}) == len(KNOWN_FILES)


@pytest.mark.parametrize(("name", "kind"), [
    ("depth", "depth maps"), ("rtabmap_depth", "depth maps"), ("depth_00001", "depth maps"),
    ("IMG_1_mask", "masks"), ("Masks", "masks"), ("operator_masks", "masks"),
    ("confidence", "confidence maps"), ("thumbnails", "small copies"),
    ("normal-maps", "normal maps"),
    ("images", ""), ("depthless", ""), ("unmasked", ""), ("IMG_0001", ""), ("conference", "")])
def test_names_tell_what_pictures_show(name, kind):
    assert picture_kind(name) == kind
