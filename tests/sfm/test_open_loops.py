"""Loops that a model leaves open, in evidence made by hand."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon_cli.sfm.limits import MIN_POSE_INLIERS
from recon_cli.sfm.verdict.evidence import MatchEvidence
from recon_cli.sfm.verdict.open_loops import find_open_loops

COUNT = 40  # images on a ring, of which the last ones see again what the first ones saw
NAMES = tuple(f"{index:06d}.png" for index in range(COUNT))
ORDER = np.arange(COUNT)
RADIUS = 4.0
MIDDLE = np.array([RADIUS, 0.0, 3.0])  # of what they see


def made(copies, *, pairs=((0, 36), (1, 36), (1, 37), (2, 38)), points=200) -> MatchEvidence:
    """A ring whose last images show `copies` of the points [P, 3] that its first ones show."""
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    first = MIDDLE + np.random.default_rng(0).uniform(-2, 2, (points, 3))
    share = np.array_split(np.arange(points), len(pairs))
    return MatchEvidence(
        names=NAMES, registered=np.ones(COUNT, bool),
        centers=RADIUS * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]),
        keypoints=np.full(COUNT, 1000), visible=np.ones((COUNT, 2 * points), bool),
        tried=np.ones((COUNT, COUNT), bool), pairs=np.array(pairs),
        matches=np.array([len(rows) for rows in share]), agreeing=np.zeros(len(pairs), int),
        explained=np.zeros(len(pairs), int), traced=np.zeros(len(pairs), int),
        joined=np.zeros(len(pairs), int), positions=np.concatenate([first, copies(first)]),
        depths=np.full(COUNT, 4.0),
        doubled={row: np.column_stack([rows, rows + points]) for row, rows in enumerate(share)})


def drifted(scale=1.0, degrees=0.0, shift=0.0):
    """Turns, scales and shifts points about the middle of the place."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return lambda points: MIDDLE + scale * (points - MIDDLE) @ turn.T + [shift, 0, 0]


@pytest.mark.parametrize(("scale", "degrees", "shift"), [
    (1.37, 0.0, 0.5), (1 / 1.37, 5.0, -0.5), (1.0, 8.0, 0.3), (1.0, 0.0, 2.0)])
def test_a_place_that_the_model_has_twice_gives_the_motion_between_both(scale, degrees, shift):
    loop, = find_open_loops(made(drifted(scale, degrees, shift)), ORDER)
    assert loop.scale == pytest.approx(1 / scale, rel=1e-3)
    assert loop.turn_deg == pytest.approx(degrees, abs=0.1)
    assert (loop.first < loop.second, loop.pairs, loop.points) == (True, 4, 200)


def test_the_order_of_a_pair_does_not_matter():
    evidence = made(drifted(1.3, 0.0, 0.5))
    turned = dataclasses.replace(
        evidence, pairs=evidence.pairs[:, ::-1],
        doubled={row: points[:, ::-1] for row, points in evidence.doubled.items()})
    assert find_open_loops(turned, ORDER)[0].scale == pytest.approx(1 / 1.3, rel=1e-3)


def test_a_closed_loop_is_not_open():
    assert find_open_loops(made(drifted()), ORDER) == ()


@pytest.mark.parametrize("motion", [(1.0, 180.0, 0.0), (1.0, 30.0, 0.0), (1.0, 0.0, 9.0)])
def test_two_places_that_look_alike_are_no_loop(motion):
    """They are further apart than a way of 23 units drifts."""
    assert find_open_loops(made(drifted(*motion)), ORDER) == ()


def test_matches_that_agree_on_nothing_are_no_loop():
    noise = np.random.default_rng(1).uniform(-2, 2, (200, 3))
    assert find_open_loops(made(lambda points: points[::-1] + noise), ORDER) == ()


def test_few_points_one_image_or_an_unknown_order_say_nothing():
    copies = drifted(1.37, 0.0, 0.5)
    assert find_open_loops(made(copies, points=MIN_POSE_INLIERS - 2), ORDER) == ()
    assert find_open_loops(made(copies, pairs=((0, 36), (0, 37), (0, 38))), ORDER) == ()
    assert find_open_loops(made(copies), None) == ()


def test_pairs_far_from_each_other_are_loops_of_their_own():
    pairs = ((0, 36), (1, 37), (0, 18), (1, 19))
    loops = find_open_loops(made(drifted(1.3, 0.0, 0.5), pairs=pairs), ORDER)
    assert [loop.pairs for loop in loops] == [2, 2]
