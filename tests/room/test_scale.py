"""The scale by a known distance between two places."""

from __future__ import annotations

import numpy as np
import pytest
from facts import assert_facts, raises

from recon_cli.errors import ConfigError
from recon_cli.room.scale import Place, ScaleBetween, measure, parse_place
from recon_cli.scene.camera import Lens

NAMES = ("000001.png", "000002.png", "IMG 7.jpg", "twin.jpg", "twin.png")
PINHOLE = Lens("PINHOLE", 600, 400, (300.0, 300.0, 300.0, 200.0))


@pytest.mark.parametrize(("text", "place"), [
    ("000001.png", Place("000001.png")),
    ("000002", Place("000002.png")),
    ("IMG 7.jpg", Place("IMG 7.jpg")),
    ("1,-2.5,3e-1", Place(xyz=(1, -2.5, 0.3))),
    ("-1, 2, 3", Place(xyz=(-1, 2, 3))),
    ("000001.png:120,200.5", Place("000001.png", pixel=(120, 200.5))),
    ("IMG 7:1,2", Place("IMG 7.jpg", pixel=(1, 2))),
])
def test_the_three_forms_of_a_place(text, place):
    assert parse_place(text, NAMES) == place


@pytest.mark.parametrize("text", [
    "000003.png", "twin", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "inf,0,0", "000009.png:1,2", ":1,2",
    "000001.png:1", "000001.png:1,2,3", "",
])
def test_what_names_no_place_is_refused_with_the_frames_near_it(text):
    with pytest.raises(ConfigError) as caught:
        parse_place(text, NAMES)
    assert caught.value.exit_code == 2
    assert any(name in caught.value.message for name in NAMES)
    assert "FRAME:u,v" in caught.value.hint


def test_the_frame_that_was_meant_is_among_those_named():
    with raises(ConfigError, "IMG", "7.jpg"):
        parse_place("IMG7.jpg", NAMES)


def two_cameras():
    """Two cameras 2 units apart that look along +z, at points 4 and 8 units away."""
    first, second = np.eye(4), np.eye(4)
    second[0, 3] = -2
    points = np.array([[0, 0, 4.0], [1, 0, 4], [1.02, 0, 8], [0, 0, -4]])
    return points, {"a.png": first, "b.png": second}


def measured(a: str, b: str, metres: float = 3.0):
    points, viewmats = two_cameras()
    return measure(ScaleBetween(a, b, metres), points, viewmats, dict.fromkeys(viewmats, PINHOLE))


def test_two_cameras_and_their_distance_give_the_scale():
    measurement = measured("a.png", "b.png")
    assert measurement.scale == 1.5
    assert np.array_equal(measurement.b, [2, 0, 0])


def test_a_pixel_takes_the_depth_of_the_sparse_point_that_it_shows():
    """x = (u - 300) / 300 * 4 at the depth of the point there, not the position of the point."""
    measurement = measured("a.png:302,200", "0,0,0")
    assert np.allclose(measurement.a, [2 / 300 * 4, 0, 4])
    assert np.allclose(measured("a.png:375,200", "0,0,0").a, [1, 0, 4])
    assert np.allclose(measured("b.png:225,200", "0,0,0").a, [1, 0, 4])


def test_two_pixels_measure_what_lies_between_them():
    assert measured("a.png:300,200", "a.png:375,200", 0.5).scale == pytest.approx(0.5)


def test_a_pixel_without_a_point_names_the_nearest_that_has_one():
    with pytest.raises(ConfigError) as caught:
        measured("a.png:310,200", "0,0,0")
    assert_facts(caught.value.message, 4, "within")
    assert "a.png:300,200" in caught.value.hint


def test_a_pixel_outside_of_the_image_is_refused():
    with raises(ConfigError, "600x400"):
        measured("a.png:700,200", "0,0,0")


def test_a_point_behind_the_camera_is_not_seen():
    points, viewmats = two_cameras()
    request = ScaleBetween("a.png:300,200", "1,1,1", 1.0)
    with raises(ConfigError, "sparse", "point"):
        measure(request, points[3:], viewmats, dict.fromkeys(viewmats, PINHOLE))


@pytest.mark.parametrize(("a", "b"), [
    ("a.png", "0,0,0"), ("1,2,3", "1.0,2.0,3.0"), ("a.png", " a"), ("a.png:375,200", "1,0,4")])
def test_two_names_of_one_point_are_refused(a, b):
    with raises(ConfigError, "point"):
        measured(a, b)


def test_the_error_of_a_length_is_that_of_its_picks_and_of_its_ends():
    ends = 2**0.5 * 0.003
    assert measured("a.png", "b.png").error == pytest.approx(np.hypot(0.003, ends / 3))
    # across the line of sight, the depth of both picks changes the length by as much
    across = measured("a.png:300,200", "a.png:375,200", 3.0)
    assert across.error == pytest.approx(np.hypot(0.007, ends / 3))
    # from the second camera, whose pick lies 4 units ahead, along it: .7% of 4 in a length of 4
    along = measured("b.png:225,200", "1,0,2", 2.0)
    ray = np.array([-1.0, 0, 4])
    share = 0.007 * ray @ [0, 0, 2] / 4
    assert along.error == pytest.approx(np.hypot(share, ends / 2))
    assert share == pytest.approx(2 * 0.007)
    # a sheet of paper says less than a wall
    assert measured("a.png", "b.png", 0.3).error > measured("a.png", "b.png", 3.0).error
