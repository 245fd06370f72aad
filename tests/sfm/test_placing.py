"""A COLMAP model that moves keeps what it saw."""

from __future__ import annotations

import numpy as np
import pycolmap
from test_similarity import random_similarity

from recon_cli.sfm.align_world import place


def residuals(model: pycolmap.Reconstruction) -> np.ndarray:
    """The offset of each observation from its projected point, in pixels."""
    found = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        for seen in image.points2D:
            if seen.has_point3D():
                xyz = model.point3D(seen.point3D_id).xyz
                found.append(image.project_point(xyz) - seen.xy)
    return np.array(found)


def test_every_observation_keeps_its_error_and_the_model_can_be_saved(tmp_path):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, 40
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.8
    pycolmap.synthesize_noise(noise, model)
    similarity = random_similarity(1)
    before = residuals(model)
    centers = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    points = {i: point.xyz.copy() for i, point in model.points3D.items()}
    place(model, similarity)
    assert np.abs(before).max() > 0.1
    assert np.allclose(residuals(model), before, rtol=0, atol=1e-8)
    for i, center in centers.items():
        moved = model.image(i).projection_center()
        assert np.allclose(moved, similarity.points(center), atol=1e-9)
    for i, xyz in points.items():
        assert np.allclose(model.point3D(i).xyz, similarity.points(xyz), atol=1e-9)
    model.write(tmp_path)
    assert np.allclose(residuals(pycolmap.Reconstruction(tmp_path)), before, atol=1e-8)
