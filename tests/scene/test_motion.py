"""Velocities of cameras from the poses around them in time."""

import numpy as np
import pytest

from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.motion import Moment, Motion, camera_motions

EYE, TARGET, UP = np.array([0.0, 0, 1.5]), np.array([3.0, 1, 1]), np.array([0.0, 0, 1])
CAMERA = Camera(600, 340, 300.0, 310.0, 305.0, 168.0, looking_at(EYE, TARGET, UP))
MOTION = Motion(np.array([0.1, 0.5, -0.2]), np.array([0.3, -0.2, 0.1]))
POINTS = np.array([[3.0, 1, 1], [4, 0, 2], [2, 1.2, 0.5]])


def pixels(camera):
    seen = POINTS @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def moments(times, source="walk.mp4"):
    return {name: Moment(source, seconds) for name, seconds in times.items()}


def test_the_flow_is_the_slope_of_the_projection():
    reach = 1e-6
    slope = (pixels(MOTION.at(CAMERA, reach)) - pixels(MOTION.at(CAMERA, -reach))) / (2 * reach)
    assert MOTION.flow(CAMERA, POINTS) == pytest.approx(slope, rel=1e-6, abs=1e-4)


def test_a_steady_motion_is_found_at_uneven_times_and_at_the_ends():
    times = {"a": 2.0, "b": 2.1, "c": 2.25}
    cameras = {name: MOTION.at(CAMERA, seconds) for name, seconds in times.items()}
    found = camera_motions(cameras, moments(times))
    for motion in found.values():
        assert motion.turn == pytest.approx(MOTION.turn, abs=1e-9)
        assert motion.move == pytest.approx(MOTION.move, abs=1e-9)
    assert set(found) == set(times)


def test_a_motion_that_grows_is_that_of_the_moment():
    def at(seconds):
        return Motion(np.zeros(3), np.array([seconds, 0, 0])).at(CAMERA, seconds)  # x = t^2

    times = {"a": 0.9, "b": 1.0, "c": 1.2}
    found = camera_motions({name: at(seconds) for name, seconds in times.items()}, moments(times))
    assert found["b"].move == pytest.approx([2.0, 0, 0], abs=1e-9)


def test_nothing_is_said_of_photos_other_videos_and_long_gaps():
    cameras = dict.fromkeys("abcd", CAMERA)
    assert camera_motions(cameras, {}) == {}
    apart = moments({"a": 0.0}) | moments({"b": 0.1}, "other.mp4") | moments({"c": 5.0})
    assert camera_motions(cameras, apart) == {}
    assert camera_motions(cameras, moments({"a": 1.0, "b": 1.0})) == {}, "no time passed"
