"""Panoramas of a rendered walk, from the pictures to cameras, faces and scores."""

import shutil

import numpy as np
import pytest

from recon_cli.cli import main
from recon_cli.evaluation.scores import Metrics
from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.faces import CUBE
from recon_cli.sfm.poses.known_poses import align_to_given

pytestmark = pytest.mark.integration


def test_a_walk_of_panoramas_becomes_cameras_faces_and_scores(tmp_path, shared_data):
    room = shared_data / "rooms360" / "office"
    pictures = sorted((room / "images").iterdir())[:15]
    (tmp_path / "walk").mkdir()
    for path in pictures:
        shutil.copy(path, tmp_path / "walk" / path.name)
    workspace = tmp_path / "ws"
    options = ["-w", str(workspace), "--quiet"]
    assert main(["ingest", str(tmp_path / "walk"), "--max-size", "384", *options]) == 0
    assert main(["sfm", *options]) == 0
    model = pycolmap.Reconstruction(workspace / "place" / "sparse")
    assert model.num_reg_images() == len(pictures)
    images = [model.find_image_with_name(f"{path.stem}.png") for path in pictures]
    found = np.array([
        np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])
    truth = np.loadtxt(room / "pano_traj.txt").reshape(-1, 4, 4)[:len(pictures)]
    model.transform(align_to_given(found, np.linalg.inv(truth)))
    off = np.array([image.projection_center() for image in images]) - truth[:, :3, 3]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.003  # metres
    faces = sorted((workspace / "place" / "undistorted" / "images").iterdir())
    assert len(faces) == len(CUBE) * len(pictures)
    assert main(["train", "--iterations", "60", "--max-size", "128", *options]) == 0
    assert main(["eval", "--no-trust", *options]) == 0
    metrics = Metrics.read(workspace / "evaluate")
    scores = metrics.models["base"].views
    assert [score.name for score in scores] == [f"{pictures[k].stem}.png" for k in (0, 8)]
    assert all(0.8 < (score.pixels_scored or 0) < 0.97 for score in scores)  # pole and operator
    assert (workspace / "evaluate" / "renders" / "base" / f"{pictures[0].stem}.png").exists()
