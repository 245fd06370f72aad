"""Measures of rooms whose planes are known: what is measured, and what is said not to be found."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest
from facts import assert_facts

from recon_cli.io.meshes import Mesh
from recon_cli.room.measures import cut_mesh, measure_room
from recon_cli.room.plan_svg import describe, draw_plan
from recon_cli.room.planes import Plane

UP = np.array([0.0, 0.0, 1.0])
CENTERS = np.array([[1.0, 1.0, 1.5], [3.0, 2.0, 1.4], [2.0, 3.0, 1.6]])
SIDES = {"floor": ((0, 0, 1), 0.0), "ceiling": ((0, 0, -1), -2.5), "west": ((1, 0, 0), 0.0),
         "east": ((-1, 0, 0), -5.0), "south": ((0, 1, 0), 0.0), "north": ((0, -1, 0), -4.0)}


def plane(normal, offset, area=10.0, spread=0.01):
    return Plane(np.array(normal, float), offset, area, spread, np.arange(0)), None


def box(width=5.0, depth=4.0, height=2.5) -> Mesh:
    """The inside of a box with a corner at the origin; the floor is fine enough to be cut up."""
    corners = np.array([[x, y, z] for x in (0, width) for y in (0, depth) for z in (0, height)])
    faces = np.array([[0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5], [0, 1, 5], [0, 5, 4],
                      [2, 6, 7], [2, 7, 3], [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6]])
    return Mesh(corners, faces, np.zeros((8, 3), np.uint8))


def measured(names, mesh=None, scale_error=0.0):
    return measure_room(
        mesh or box(), [plane(*SIDES[name]) for name in names], CENTERS, UP, scale_error)


def test_a_box_has_its_height_walls_and_area():
    room = measured(SIDES)
    assert room.height.value == pytest.approx(2.5)
    assert room.height.error == pytest.approx(1.96 * np.hypot(0.005, 0.005))
    assert sorted(wall.value for wall in room.walls) == pytest.approx([4, 4, 5, 5])
    assert room.floor_area.value == pytest.approx(20.0)
    assert room.notes == ()


def test_the_error_of_the_scale_widens_every_interval():
    room = measured(SIDES, scale_error=0.01)
    assert room.height.error == pytest.approx(1.96 * np.hypot(0.005 * 2**0.5, 0.025))
    assert room.floor_area.error > 1.96 * 2 * 0.01 * 20


def test_furniture_parallel_to_a_wall_is_no_wall():
    planes = [plane(*side) for side in SIDES.values()] + [plane((1, 0, 0), 0.4, area=4.0)]
    room = measure_room(box(), planes, CENTERS, UP, 0.0)
    assert room.floor_area.value == pytest.approx(20.0)


def test_fog_a_little_behind_a_confirmed_wall_is_that_wall():
    walls = {name: plane(*side) for name, side in SIDES.items()}
    south = walls["south"][0]
    fog = plane((0.04, 1, 0), 0.0)
    sure = [*walls.values()]
    sure[list(SIDES).index("south")] = south, south
    room = measure_room(box(), [*sure, fog], CENTERS, UP, 0.0)
    assert sorted(wall.value for wall in room.walls) == pytest.approx([4, 4, 5, 5])
    assert room.floor_area.value == pytest.approx(20.0)
    # a wall that no point confirms, behind a cupboard that they do, is the wall
    cupboard = plane((0, 1, 0), 0.4)[0]
    walls["cupboard"] = cupboard, cupboard
    room = measure_room(box(), [*walls.values()], CENTERS, UP, 0.0)
    assert room.floor_area.value == pytest.approx(20.0)


def test_a_wall_of_surface_alone_that_leans_is_uncertain_by_as_much():
    planes = {name: plane(*side) for name, side in SIDES.items()}
    straight = measure_room(box(), [*planes.values()], CENTERS, UP, 0.0)
    north = planes["north"][0]
    planes["north"] = north, north
    planes["south"] = plane((0.04, (1 - 0.04**2) ** 0.5, 0), 0.1)
    room = measure_room(box(), [*planes.values()], CENTERS, UP, 0.0)
    short = [wall for wall in room.walls if wall.value < 4.5]
    assert len(short) == 2
    assert all(0.02 < abs(wall.value - 4) < wall.error for wall in short)
    assert abs(room.floor_area.value - 20) < room.floor_area.error
    assert room.floor_area.error > 5 * straight.floor_area.error


@pytest.mark.parametrize(("left_out", "words"), [
    ("ceiling", "No ceiling"), ("floor", "No floor"), ("east", "do not enclose")])
def test_what_is_not_found_is_said(left_out, words):
    room = measured([name for name in SIDES if name != left_out])
    assert any(words in note for note in room.notes)
    assert (room.height is None) == (left_out in ("ceiling", "floor"))
    assert (room.footprint is None) == (left_out == "east")


def test_one_wall_is_measured_as_no_room():
    room = measured(["east"])
    assert (room.height, room.floor_area, room.footprint, room.walls) == (None, None, None, ())
    assert len(room.notes) == 3


def test_a_floor_that_goes_on_behind_a_wall_has_no_footprint():
    room = measured(SIDES, mesh=box(width=8.0))
    assert room.footprint is None
    assert_facts("\n".join(room.notes), "convex")


def test_the_cut_of_a_box_is_its_outline():
    cut = cut_mesh(box(), UP, 1.0)
    assert np.allclose(cut[..., 2], 1.0)
    assert np.linalg.norm(cut[:, 0] - cut[:, 1], axis=1).sum() == pytest.approx(18.0)
    assert len(cut_mesh(box(), UP, 9.0)) == 0


@pytest.mark.parametrize("names", [list(SIDES), ["east"], []])
def test_the_plan_is_xml_with_its_dimensions_written_on(names):
    room = measured(names)
    root = ElementTree.fromstring(draw_plan(room))
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert all(line in texts for line in describe(room))
    assert sum("5.00 \u00b1" in text for text in texts) == (2 if room.walls else 0)
