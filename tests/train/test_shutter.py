"""The blur that the motion of the camera explains, and the time that the shutter was open."""

from functools import cache

import numpy as np
import pytest
from blurred_wall import filmed
from wall_scene import scene

from recon_cli.train.shutter import BlurEvidence, find_blur, median_speed

pytestmark = pytest.mark.integration


@cache
def evidence(shutter):
    task, _ = filmed(scene().task, shutter)
    return task.motions.find_blur(task.train)


def test_fast_views_that_are_less_sharp_along_their_motion_speak_for_blur():
    assert evidence(0.06).speaks, evidence(0.06)


def test_sharp_views_do_not():
    assert not evidence(0.0).speaks, evidence(0.0)


def test_a_shutter_that_is_open_longer_is_found_to_be():
    assert 1.3 < evidence(0.08).seconds / evidence(0.04).seconds < 3


def test_without_times_or_with_few_views_there_is_no_evidence():
    task, _ = filmed(scene().task, 0.06)
    nothing = BlurEvidence.nothing()
    assert find_blur(task.train, [None] * len(task.train), task.motions.points) == nothing
    assert find_blur(task.train[:9], task.motions.train[:9], task.motions.points) == nothing
    assert not nothing.speaks


def test_the_speed_is_that_of_the_wall_in_the_image():
    task, _ = filmed(scene().task, 0.0)
    for view, motion in zip(task.train, task.motions.train, strict=True):
        speed = abs(motion.move[0]) * view.camera.fx / 2.0  # all of it is 2 away
        assert median_speed(view.camera, motion, task.motions.points) == pytest.approx(speed)
    assert median_speed(view.camera, motion, np.array([[0.0, 0, -5]])) == 0
