"""The room on the page: what export measured, what it did not find, and what is damaged."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
from facts import assert_facts

from recon_cli.report.room import read_room

VALUE = {"unit": "m", "ceiling_height": {"value": 2.5, "error": 0.02}, "floor_area": None,
         "walls": [{"value": 4.0, "error": 0.001}], "footprint": None, "notes": ["No floor."]}


@pytest.fixture
def export(tmp_path):
    (tmp_path / "measures.json").write_text(json.dumps(VALUE))
    (tmp_path / "plan.svg").write_text("<svg/>")
    return SimpleNamespace(there=True, folder=tmp_path, parts=())


def test_measures_are_shown_with_their_intervals(export):
    room = read_room(export)
    assert ("Ceiling height", "2.50 \u00b1 0.02 m") in room.figures
    assert ("Walls", "4.00 \u00b1 0.01 m") in room.figures
    assert "Floor area" not in dict(room.figures)
    assert room.notes == ("No floor.",)
    assert room.plan.startswith("data:image/svg+xml;base64,")


def test_measures_that_were_kept_of_an_earlier_export_are_called_stale(export):
    export.parts = [SimpleNamespace(
        name="export.plan.svg", fresh=False, why="sfm's output changed")]
    stale, note = read_room(export).notes
    assert_facts(stale, "stale", "sfm's output changed")
    assert note == "No floor."


def test_without_a_plan_there_is_no_room(export):
    (export.folder / "measures.json").unlink()
    assert read_room(export) is None


@pytest.mark.parametrize("text", ["", "{}", '{"walls": 3}', "[1]"])
def test_damaged_measures_are_said_to_be_damaged(export, text):
    (export.folder / "measures.json").write_text(text)
    room = read_room(export)
    assert room.figures == ()
    assert_facts(room.notes[0], "not shown")
