"""Measures of clicked points, and where a click meets the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from facts import assert_facts

from recon_cli.scene.splats import Splats
from recon_cli.viewer.measure import (
    LENGTHS,
    SHEETS,
    describe_points,
    find_scale,
    locate_click,
    polygon_area,
    scale_command,
    scale_of,
)

SQUARE = np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1]], float)


def wall(z: float) -> Splats:
    """A flat opaque Gaussian across the z axis."""
    return Splats(
        means=torch.tensor([[0.0, 0.0, z]]), quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.log(torch.tensor([[1.0, 1.0, 1e-3]])),
        logit_opacities=torch.tensor([5.0]), sh_dc=torch.zeros(1, 3),
        sh_rest=torch.zeros(1, 0, 3))


def test_a_click_meets_the_surface_along_its_ray_not_the_centre():
    direction = np.array([0.1, 0.05, 1.0])
    point = locate_click(wall(3.0), np.zeros(3), direction, "torch")
    assert np.allclose(point, 3 * direction, atol=0.01)


def test_a_click_into_the_void_meets_nothing():
    assert locate_click(wall(3.0), np.zeros(3), np.array([0.0, 0.0, -1.0]), "torch") is None


def test_a_square_has_its_area_whichever_way_it_is_clicked():
    assert polygon_area(SQUARE) == pytest.approx(4.0)
    assert polygon_area(SQUARE[::-1] @ np.linalg.qr(np.random.default_rng(0).normal(
        size=(3, 3)))[0] + 7) == pytest.approx(4.0)


def test_two_points_are_a_distance_and_more_an_area():
    assert "Click two points" in describe_points(SQUARE[:1], 1.0)
    assert "Distance: **2.000 m**" in describe_points(SQUARE[:2], 1.0)
    assert "Area: **1.000 m\u00b2**" in describe_points(SQUARE, 0.5)


def test_without_a_scale_nothing_is_called_a_metre():
    for count in (2, 4):
        text = describe_points(SQUARE[:count], None)
        assert_facts(text, "scale")
        assert " m*" not in text
        assert " m\u00b2" not in text


def test_one_known_length_sets_the_scale():
    assert scale_of(SQUARE[:2], 3.0) == pytest.approx(1.5)
    assert scale_of(SQUARE[:1], 3.0) is None
    assert scale_of(SQUARE[[0, 0]], 3.0) is None
    for metres in (0.0, -1.0, math.nan, math.inf):
        assert scale_of(SQUARE[:2], metres) is None
    assert scale_command(SQUARE[:2], 3.0) == "recon export --scale-between 0,0,1 2,0,1 3"


def turned(points: np.ndarray) -> np.ndarray:
    return points @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0] + [3, 1, 2]


@pytest.mark.parametrize("known", SHEETS)
@pytest.mark.parametrize("first", range(4))
def test_the_corners_of_a_sheet_set_the_scale_whichever_comes_first(known, first):
    long, short = SHEETS[known]
    sheet = np.array([[0, 0, 0], [long, 0, 0], [long, short, 0], [0, short, 0]])
    points = turned(np.vstack([[[9, 9, 9]], np.roll(sheet, first, axis=0) / 0.4]))
    scale, command = find_scale(points, known, 0.0)
    assert scale == pytest.approx(0.4)
    words = command.split()
    a, b = (np.array([float(number) for number in word.split(",")]) for word in words[3:5])
    # the command says the same: metres for as many units
    assert float(words[5]) / np.linalg.norm(a - b) == pytest.approx(0.4, rel=1e-3)


def test_corners_that_form_no_sheet_set_nothing():
    known = next(iter(SHEETS))
    assert "2 of 4" in find_scale(SQUARE[:2], known, 0.0)
    for corners in (SQUARE, SQUARE[[0, 2, 1, 3]] * [1.41, 1, 1], SQUARE[[0, 0, 1, 1]]):
        assert_facts(find_scale(corners, known, 0.0), "corners")


def test_a_door_has_its_height_and_other_lengths_are_typed():
    for known, metres in LENGTHS.items():
        assert find_scale(SQUARE[:2], known, 0.0)[0] == pytest.approx(metres / 2)
    assert find_scale(SQUARE[:2], "a length", 3.0)[0] == pytest.approx(1.5)
    for corners, metres in ((SQUARE[:2], 0.0), (SQUARE[:1], 3.0)):
        assert isinstance(find_scale(corners, "a length", metres), str)
