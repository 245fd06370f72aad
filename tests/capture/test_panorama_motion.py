"""A 360-degree camera that turns does not move; one that walks does, however it turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon_cli.capture.panorama_motion import WIDTH_DEG, measure_parallax
from recon_cli.io.tracks import Tracks
from recon_cli.scene.faces import panorama_pixels


def tracks(centers, turns, *, points=200, noise=0.0, seed=0):
    """Tracks of points on a sphere of radius 2 around the origin, in each of the panoramas."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(points, 3))
    places = 2 * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    xy = np.concatenate([
        panorama_pixels((places - center) @ turn.as_matrix().T, 1, 1) + rng.normal(
            scale=noise or 1e-12, size=(points, 2))
        for center, turn in zip(centers, turns, strict=True)])
    count = len(centers)
    return Tracks(
        tuple(map(str, range(count))), np.repeat(np.arange(count, dtype=np.int32), points),
        np.tile(np.arange(points, dtype=np.int32), count), xy.astype(np.float32))


def test_a_turn_on_the_spot_is_no_motion():
    turns = [Rotation.from_euler("yxz", [12 * k, 5 * np.sin(k), 3 * k], degrees=True)
             for k in range(20)]
    assert measure_parallax(tracks(np.zeros((20, 3)), turns)).sum() < 1e-4


@pytest.mark.parametrize("turning", [0.0, 15.0])
def test_a_walk_is_measured_by_its_parallax(turning):
    centers = np.zeros((11, 3))
    centers[:, 2] = np.linspace(0, 0.3, 11)
    turns = [Rotation.from_euler("y", turning * k, degrees=True) for k in range(11)]
    total = measure_parallax(tracks(centers, turns)).sum() * WIDTH_DEG
    # each point at distance 2 moves by about 0.3 / 2 sin(angle to the way): in the median .87
    assert total == pytest.approx(np.degrees(0.15 * 0.87), rel=0.15)


def test_lost_corners_are_unknown():
    some = tracks(np.zeros((3, 3)), [Rotation.identity()] * 3)
    lost = some.where(some.image != 1)
    assert np.isnan(measure_parallax(lost)[1])
