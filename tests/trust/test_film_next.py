"""Suggestions lead to what is badly seen."""

from dataclasses import replace

import numpy as np
import pytest
from small_room import EYE, UP, camera, dots, photo, room

from recon_cli.scene.scene import View
from recon_cli.trust.error_model import calibrate
from recon_cli.trust.film_next import Suggestion, suggest
from recon_cli.trust.standing_places import StandingPlaces
from recon_cli.trust.support import measure_support


@pytest.fixture(scope="module")
def suggestions(tmp_path_factory):
    """Of a room of which only the half at x > 0 was filmed."""
    folder = tmp_path_factory.mktemp("film")
    splats = dots(room(step=0.2), radius=0.12)
    cameras = [camera([0.2, y, EYE], [2, y, 1.2]) for y in (-0.8, -0.3, 0.3, 0.8)]
    photos = [photo(splats, taken) for taken in cameras]
    support = measure_support(splats, photos, sh_degree=0, backend="torch")
    model = calibrate(splats, support, photos[:1], photos, sh_degree=0, backend="torch")
    views = [View(f"{i}.png", taken, folder, folder) for i, taken in enumerate(cameras)]
    places = StandingPlaces(np.array([[0.6, 0, EYE], [-0.4, 0, EYE]]), UP, 0.0, EYE)
    return suggest(splats, support, model, places, views, backend="torch"), views


def test_the_first_picture_looks_at_the_side_that_no_view_shows(suggestions):
    found, views = suggestions
    assert len(found) == 5
    first = found[0]
    assert first.forward[0] < 0.3  # away from what was filmed
    assert first.near in {view.name for view in views}
    assert first.reason


def test_what_was_suggested_is_not_suggested_again(suggestions):
    found, _ = suggestions
    poses = {(each.position, each.forward) for each in found}
    assert len(poses) == 5
    headings = np.array([each.forward[:2] for each in found])
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.clip(headings @ headings[0], -1, 1))).max() > 40


def test_a_suggestion_says_where_and_where_to_turn():
    one = Suggestion(position=(1.0, 2.0, 1.5), forward=(1.0, 0.0, 0.0), near="a.png", distance=0.5,
                     turn_deg=90.0, expected_error=0.1, reason="because")
    assert one.describe("m") == (
        "at 1.00 2.00 1.50 (0.5 m from a.png, turned 90 degrees to the right): because")
    assert "to the left" in replace(one, turn_deg=-40.0).describe("m")
    assert "facing the same way" in replace(one, turn_deg=5.0).describe("m")
    assert "facing the other way" in replace(one, turn_deg=-175.0).describe("m")
    assert "0.5 scene units from" in one.describe("scene units")


def test_without_a_place_nothing_is_suggested():
    splats = dots(room(step=0.5))
    taken = camera([0, 0, EYE], [2, 0, 1])
    views = [photo(splats, taken)]
    support = measure_support(splats, views, sh_degree=0, backend="torch")
    model = calibrate(splats, support, views, views, sh_degree=0, backend="torch")
    none = StandingPlaces(np.zeros((0, 3)), UP, 0.0, EYE)
    assert suggest(splats, support, model, none, [], backend="torch") == []
