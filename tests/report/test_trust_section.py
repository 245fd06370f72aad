"""The section on trust, and the numbers on the plan."""

import json
import re

import numpy as np
import pytest
from facts import assert_facts
from report_workspace import page_of, section

from recon_cli.io.colmap import read_scene
from recon_cli.report.capture import draw_plan, find_axes
from recon_cli.report.trust_section import TrustSection
from recon_cli.scene.scene import Scene
from recon_cli.trust.records import RECORD, PoorlySeenRegion

REGION = PoorlySeenRegion(position=(0.1, 0.2, 1.5), size=1.0, share=0.05, few=True, views=2,
                          span_deg=3.0, frame="<b>000001</b>.png")


def change(workspace, **fields):
    path = workspace / "evaluate" / "trust" / RECORD
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


@pytest.mark.integration
def test_shares_reliability_and_heat_maps_are_shown(workspace):
    shown = section(page_of(workspace), "trust")
    assert_facts(shown, "surface", "seen")
    assert "AUSE" in shown
    assert_facts(shown, "calibrated")
    assert shown.count("Expected error of") == 3  # held-out views
    change(workspace, poorly_seen=[])
    assert_facts(section(page_of(workspace), "trust"), "Nowhere", "region")


@pytest.mark.integration
def test_poorly_seen_regions_are_listed_escaped_and_drawn_in_the_plan(workspace):
    change(workspace, poorly_seen=[REGION.to_json()])
    page = page_of(workspace)
    shown = section(page, "trust")
    assert "&lt;b&gt;000001" in shown
    assert "<b>000001" not in page
    assert_facts(shown, 1, "units")
    assert 'class="next"' in section(page, "capture")
    change(workspace, poorly_seen=[REGION.to_json()], metres=True)
    assert "1 m across" in section(page_of(workspace), "trust")


@pytest.mark.integration
def test_a_reason_stands_in_place_of_trust(workspace):
    change(workspace, reason="The scene was imported without views.", models=[])
    shown = section(page_of(workspace), "trust")
    assert "The scene was imported without views." in shown
    assert "AUSE" not in shown


@pytest.mark.integration
def test_damaged_or_missing_files_are_said(workspace):
    (workspace / "evaluate" / "trust" / RECORD).write_text("{")
    assert_facts(section(page_of(workspace), "trust"), "not shown", RECORD)
    (workspace / "evaluate" / "trust" / RECORD).unlink()
    assert_facts(section(page_of(workspace), "trust"), "not measured")
    assert TrustSection("none").regions == ()


def test_a_region_off_the_path_fits_into_the_plan(workspace):
    scene: Scene = read_scene(
        workspace / "place" / "undistorted", held_out=frozenset(), validation=0.0)
    far = PoorlySeenRegion(**{**vars(REGION), "position": (30.0, -20.0, 1.0)})
    plan = str(draw_plan(scene, find_axes(scene, z_up=True), metres=False, regions=[far]))
    x = float(re.search(r'<text x="([-\d.]+)"[^>]* class="next"', plan)[1])
    assert 0 < x < 640
    assert np.isfinite(x)
