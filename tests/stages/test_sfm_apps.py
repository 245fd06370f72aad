"""Captures of scanning apps through ingest and sfm: the cameras end where they were, z up."""

import dataclasses
import shutil

import numpy as np
import pytest
from app_sets import APPS
from app_shots import shots
from ingest_media import take
from sfm_inputs import run

from recon_cli.io.colmap import read_images
from recon_cli.workspace.records import read_frame_list

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("name", ["polycam", "record3d", "metashape"])
def test_kept_poses_end_in_metres_with_z_up(name, shared_data, tmp_path):
    app = APPS[name]
    taken = shots(shared_data / "rooms" / "office", count=12, step=5, factor=1)
    app.write(tmp_path / "capture", taken)
    take(tmp_path / "capture", tmp_path / "ingest")
    shutil.copytree(tmp_path / "ingest" / "frames", tmp_path / "denoise" / "frames")
    summary = run(tmp_path, tmp_path / "sfm", poses="keep")
    assert summary.world.evidence.metres
    listed = read_frame_list(tmp_path / "ingest").frames
    viewmats = {image: viewmat for image, _, viewmat in read_images(
        tmp_path / "sfm" / "sparse" / "images.bin")}
    order = sorted(listed, key=lambda frame: (len(frame.source), frame.source))
    assert len(viewmats) == len(order) == len(taken)
    found = np.stack([np.linalg.inv(viewmats[frame.name]) for frame in order])
    truth = np.stack([shot.c2w for shot in taken])
    # A rigid motion, without a scale, takes one to the other.
    motion = truth[0] @ np.linalg.inv(found[0])
    np.testing.assert_allclose(motion @ found, truth, atol=1e-4)
    if app.up is not None:
        assert summary.world.evidence.up_found
        np.testing.assert_allclose(motion[2, :3], [0, 0, 1], atol=1e-5)
    else:  # found from the scene, or left and said so
        assert summary.world.evidence.up_found or summary.world.evidence.up_reason
        if summary.world.evidence.up_found:
            assert motion[2, 2] > np.cos(np.radians(3))


def test_depth_that_contradicts_the_poses_is_no_source_of_the_scale(shared_data, tmp_path):
    # 30% is too little to be a unit, and too much for either to be right.
    taken = [dataclasses.replace(shot, depth=1.3 * shot.depth) for shot in shots(
        shared_data / "rooms" / "office", count=20, step=4, factor=1)]
    APPS["nerfcapture"].write(tmp_path / "capture", taken)
    take(tmp_path / "capture", tmp_path / "ingest")
    shutil.copytree(tmp_path / "ingest" / "frames", tmp_path / "denoise" / "frames")
    evidence = run(tmp_path, tmp_path / "sfm").world.evidence
    assert evidence.metres
    assert len(evidence.scale_sources) == 1  # the poses
