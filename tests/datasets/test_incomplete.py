"""Captures that lack the file of their poses are refused by name, with what to type instead."""

import re
import shutil
from pathlib import Path

import pytest
from app_sets import APPS
from app_shots import shots
from facts import raises
from ingest_media import take

from recon_cli.datasets.layouts import recognise, refuse_incomplete
from recon_cli.errors import FormatError

# app, its files that are lost, and what the message names
LOST = [
    ("polycam", ["keyframes/corrected_cameras", "keyframes/cameras"], "Polycam"),
    ("record3d", ["EXR_RGBD/metadata.json"], "Record3D"),
    ("r3d", ["metadata"], "Record3D"),
    ("stray", ["odometry.csv"], "Stray Scanner"),
    ("stray", ["rgb.mp4"], "Stray Scanner"),
    ("nerfcapture", ["transforms.json"], "NeRFCapture"),
    ("3dscannerapp", ["frame_*.json"], "3D Scanner App"),
    ("arkitscenes", ["42444946_frames/lowres_wide.traj"], "ARKitScenes"),
    ("rtabmap", ["rtabmap_camera_poses.txt"], "RTAB-Map"),
    ("quest", ["*_frame_metadata.csv"], "Quest headset"),
]


@pytest.fixture(scope="session")
def frames(shared_data):
    return shots(shared_data / "rooms" / "office", count=4, factor=4, moving=False)


@pytest.mark.parametrize(("name", "lost", "app"), LOST)
def test_a_capture_without_its_poses_is_refused_with_its_pictures_named(
    name, lost, app, frames, tmp_path
):
    folder = tmp_path / "capture"
    folder.mkdir()
    APPS[name].write(folder, frames)
    refuse_incomplete(folder)  # all is there
    for pattern in lost:
        for path in list(folder.glob(pattern)):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert recognise(folder) is None
    files = lost if name in ("record3d", "r3d", "stray", "nerfcapture") else ()
    with raises(FormatError, app, *files) as caught:
        refuse_incomplete(folder)
    found = re.search(r"or give (\S+) to estimate", caught.value.hint)
    if found is None:  # no pictures that others could read
        assert name in ("quest", "stray")
        return
    given = Path(found[1])
    if name == "stray":  # four frames of video are too few to take some of
        assert given.is_file()
        return
    inputs = tuple(sorted(given.parent.glob(given.name)))
    refuse_incomplete(inputs[0])
    out = tmp_path / "out"
    kind = take(inputs[0] if len(inputs) == 1 else inputs, out).kind
    assert kind == "photos"


@pytest.mark.parametrize("name", APPS)
def test_a_whole_capture_is_never_incomplete(name, frames, tmp_path):
    APPS[name].write(tmp_path, frames)
    refuse_incomplete(tmp_path)
