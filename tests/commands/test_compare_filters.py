"""`recon denoise --compare` in process, on photos with noise of a known level."""

import json

import numpy as np
import pytest
from noisy_room import noisy, plain_room
from PIL import Image

from recon_cli.cli import main


@pytest.fixture
def workspace(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(4):
        shifted = plain_room()[:, 4 * index:4 * index + 220]
        Image.fromarray(noisy(shifted, 8, seed=index)).save(photos / f"{index}.png")
    workspace = tmp_path / "ws"
    assert main(["ingest", str(photos), "-w", str(workspace)]) == 0
    return workspace


def test_what_each_filter_would_do_is_printed_and_written_beside_the_stages(workspace, capsys):
    before = {path: path.read_bytes() for path in workspace.glob("ingest/**/*") if path.is_file()}
    capsys.readouterr()
    assert main(["denoise", "--compare", "-w", str(workspace)]) == 0
    said = capsys.readouterr().out
    assert "joint" in said
    assert "(non-local means)" in said
    assert "recon denoise would use --filter joint --strength 4." in said
    found = json.loads((workspace / "compare.json").read_text())
    # A low percentile of small tiles lies under the mean.
    assert found["measured_noise_255"] == pytest.approx(8, rel=0.2)
    assert {score["filter"] for score in found["scores"]} >= {"none", "joint", "bilateral"}
    assert {path: path.read_bytes() for path in before} == before


def test_comparing_filters_nothing_and_makes_nothing_stale(workspace, capsys):
    assert main(["denoise", "--filter", "bilateral", "-w", str(workspace)]) == 0
    assert main(["denoise", "--compare", "-w", str(workspace)]) == 0
    capsys.readouterr()
    assert main(["status", "--json", "-w", str(workspace)]) == 0
    states = {one["name"]: one["state"] for one in json.loads(capsys.readouterr().out)["stages"]}
    assert (states["ingest"], states["denoise"]) == ("fresh", "fresh")


def test_where_every_filter_costs_edges_the_way_to_do_nothing_is_named(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        grain = np.random.default_rng(index).integers(60, 196, (96, 128, 3), dtype=np.uint8)
        Image.fromarray(grain).save(tmp_path / "photos" / f"{index}.png")
    workspace = str(tmp_path / "ws")
    assert main(["ingest", str(tmp_path / "photos"), "-w", workspace]) == 0
    assert main(["denoise", "--compare", "-w", workspace]) == 0
    assert "recon denoise --off does that" in capsys.readouterr().out


def test_without_frames_there_is_nothing_to_compare(tmp_path, capsys):
    assert main(["denoise", "--compare", "-w", str(tmp_path / "ws")]) == 4
    assert "recon ingest VIDEO" in capsys.readouterr().err
