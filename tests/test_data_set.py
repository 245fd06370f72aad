"""A data set with poses all the way through the command line, without structure from motion."""

import json

import numpy as np
import pytest
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.splats.ply import read_ply


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A small Replica sequence that was trained on and scored."""
    base = tmp_path_factory.mktemp("replica")
    make_replica(base / "room", frames=8, tests=2)
    assert main(["ingest", str(base / "room"), "-w", str(base / "ws")]) == 0
    options = ["--iterations", "200", "--max-gaussians", "300", "--validation", "0"]
    assert main(["train", "-w", str(base / "ws"), *options]) == 0
    assert main(["eval", "-w", str(base / "ws")]) == 0
    return base / "ws"


@pytest.mark.integration
def test_the_views_that_the_set_holds_out_are_the_ones_that_are_scored(workspace):
    metrics = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    names = [view["name"] for view in metrics["models"]["base"]["views"]]
    held = [frame["name"] for frame in json.loads(
        (workspace / "ingest" / "frames.json").read_text())["frames"] if frame["held_out"]]
    assert names == held
    assert len(names) == 2
    assert metrics["models"]["base"]["psnr_db"] > 15  # one colour: anything that fits beats this


@pytest.mark.integration
def test_nothing_was_mapped_and_the_unit_stayed(workspace):
    assert not (workspace / "sfm" / "database.db").exists()
    world = json.loads((workspace / "place" / "world.json").read_text())
    assert world["evidence"]["scale_source"] == "data set"
    assert world["evidence"]["metres"]
    splats = read_ply(workspace / "train" / "splats.ply")
    # the plane that the set shows is 4 to 6 metres away, and the depth put the points there
    assert 2 < float(np.median(splats.means[:, 2].numpy())) < 7


@pytest.mark.integration
def test_training_does_not_see_depth_or_pixels_of_held_out_views(workspace):
    manifest = json.loads((workspace / "train" / "manifest.json").read_text())
    assert manifest["summary"]["training_views"] == 8
