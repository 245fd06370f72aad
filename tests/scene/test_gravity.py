"""Up and the floor: found in a noisy room, refused where the cameras say nothing."""

from __future__ import annotations

import numpy as np
import pytest
from facts import assert_facts
from rooms import Room, degrees_between, looking, make_room

from recon_cli.scene.gravity import camera_up, find_gravity, upright_axes
from recon_cli.scene.surfaces import find_floor, find_walls

SEEDS = range(6)
# 1,000 points with 1.5 cm of noise on 5 x 4 m give a normal to 0.02 degrees; what clutter lies in
# the layer adds some. Measured: 0.05 in the worst of the seeds.
FLOOR_DEG = 0.15
FLOOR_METRES = 0.01  # measured: 0.4 cm in the worst of the seeds


def floor_metres(room: Room, floor) -> float:
    """The height of a floor in the room's frame, where the truth is 0."""
    on_floor = floor.height * floor.up
    return float(room.truth.points(on_floor)[2])


def turned_over(room: Room, share: float, degrees: float) -> Room:
    """The same room with the first cameras rolled by so much."""
    viewmats = room.viewmats.copy()
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    roll = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    for viewmat in viewmats[: round(share * len(viewmats))]:
        viewmat[:3] = roll @ viewmat[:3]
    return Room(room.points, viewmats, room.truth)


def test_level_cameras_know_up_exactly():
    viewmats = np.stack([looking(turn, 0.3 * np.sin(5 * turn), 0.0)
                         for turn in np.linspace(0, 5, 20)])
    held = camera_up(viewmats)
    assert degrees_between(held.up, np.array([0, 0, 1.0])) < 1e-6
    assert held.roll_deg < 1e-6
    assert held.error_deg < 1e-6
    assert held.upright == 1
    assert not held.sideways


def test_a_few_leaning_cameras_do_not_pull():
    rolls = np.zeros(40)
    rolls[::8] = np.radians(30)
    viewmats = np.stack([
        looking(turn, -0.2, roll) for turn, roll in zip(np.linspace(0, 6, 40), rolls, strict=True)])
    assert degrees_between(camera_up(viewmats).up, np.array([0, 0, 1.0])) < 0.1


def test_cameras_that_look_one_way_know_that_they_do_not_know():
    viewmats = np.stack([looking(turn, 0.0, roll) for turn, roll in zip(
        np.linspace(0, 0.1, 30), np.radians(np.random.default_rng(0).normal(0, 2, 30)),
        strict=True)])
    assert camera_up(viewmats).error_deg > 20


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("roll", "bias"), [(1.0, 0.0), (4.0, 2.0)])
def test_up_and_the_floor_of_a_noisy_room_are_found(seed, roll, bias):
    room = make_room(seed=seed, roll_deg=roll, roll_bias_deg=bias)
    found = find_gravity(room.points, room.viewmats)
    assert found.up is not None
    assert found.floor is not None
    assert degrees_between(found.up, room.up) < FLOOR_DEG
    assert abs(floor_metres(room, found.floor)) < FLOOR_METRES
    assert 0.22 < found.floor.share < 0.26  # 1,000 of 4,100 points were put there


@pytest.mark.parametrize("seed", SEEDS)
def test_without_a_floor_level_cameras_are_enough_and_within_three_standard_errors(seed):
    room = make_room(seed=seed, roll_deg=2.0, floor=False)
    found = find_gravity(room.points, room.viewmats)
    assert found.up is not None
    assert found.cameras is not None
    assert found.floor is None
    assert degrees_between(found.up, room.up) < 3 * found.cameras.error_deg < 6


@pytest.mark.parametrize("seed", SEEDS)
def test_cameras_that_roll_all_the_time_are_refused(seed):
    found = find_gravity(*sized(make_room(seed=seed, roll_deg=60.0)))
    assert found.up is None
    assert found.floor is None
    assert found.reason


def sized(room: Room):
    return room.points, room.viewmats


@pytest.mark.parametrize("degrees", [90.0, -90.0])
def test_a_phone_held_on_its_side_is_refused_and_named(degrees):
    found = find_gravity(*sized(turned_over(make_room(), 1.0, degrees)))
    assert found.up is None
    assert_facts(found.reason, "side")


def test_a_phone_turned_upside_down_for_a_while_changes_nothing():
    room = make_room()
    found = find_gravity(*sized(turned_over(room, 0.2, 180.0)))
    assert found.up is not None
    assert degrees_between(found.up, room.up) < FLOOR_DEG


def test_a_phone_upside_down_all_the_time_is_given_away_by_the_floor_above_it():
    found = find_gravity(*sized(turned_over(make_room(), 1.0, 180.0)))
    assert found.up is None
    assert_facts(found.reason, "above", "cameras")


def test_a_phone_upside_down_half_of_the_time_is_refused():
    found = find_gravity(*sized(turned_over(make_room(), 0.45, 180.0)))
    assert found.up is None
    assert_facts(found.reason, "upside")


def test_two_cameras_and_no_points_are_refused_without_a_crash():
    room = make_room()
    assert_facts(find_gravity(room.points, room.viewmats[:2]).reason, 2, "cameras")
    assert find_gravity(np.zeros((0, 3)), room.viewmats).floor is None
    assert not find_walls(np.zeros((0, 3)), room.up).found


def test_a_table_is_no_floor_where_things_lie_below_it():
    room = make_room(floor=False)
    table = np.random.default_rng(0).uniform([1, 1, 0.75], [3, 3, 0.75], (800, 3))
    points = np.concatenate([room.points, room.truth.inverse().points(table)])
    centers = np.linalg.inv(room.viewmats)[:, :3, 3]
    assert find_floor(points, centers, room.up, cone_deg=6.0) is None


@pytest.mark.parametrize("seed", SEEDS)
def test_walls_give_the_heading_and_clutter_alone_gives_none(seed):
    room = make_room(seed=seed)
    walls = find_walls(room.points, room.up)
    assert walls.found
    in_room = room.truth.rotation @ walls.along
    off = np.degrees(np.arctan2(in_room[1], in_room[0])) % 90
    assert min(off, 90 - off) < 0.5
    ball = np.random.default_rng(seed).normal(size=(3000, 3))
    assert not find_walls(ball, room.up).found


@pytest.mark.parametrize("walls", [True, False])
def test_the_frame_has_z_up_the_floor_at_0_and_its_origin_below_the_cameras(walls):
    room = make_room(walls=walls, turn_deg=150.0)
    found = find_gravity(room.points, room.viewmats)
    axes = upright_axes(found, room.points, room.viewmats)
    similarity = axes.similarity
    assert similarity.scale == 1
    assert degrees_between(similarity.rotation @ room.up, np.array([0, 0, 1.0])) < FLOOR_DEG
    centers = similarity.points(np.linalg.inv(room.viewmats)[:, :3, 3])
    assert np.allclose(centers.mean(axis=0)[:2], 0, atol=1e-9)
    assert abs(room.truth.scale * centers[:, 2].mean() - 1.45) < 0.05
    assert axes.walls.found == walls
    right = similarity.rotation @ room.viewmats[:, 0, :3].mean(axis=0)
    heading = abs(np.degrees(np.arctan2(right[1], right[0])))
    assert heading < (45.5 if walls else 1e-6)
