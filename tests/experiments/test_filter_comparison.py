"""`recon denoise --compare`: what filters gain and lose, and the command on noisy photos."""

import json

import cv2
import numpy as np
import pytest
from noisy_room import noisy, plain_room
from PIL import Image

from recon_cli.cli import main
from recon_cli.experiments import filter_comparison
from recon_cli.experiments.filter_comparison import FilterScore, edges_kept


def score(name, psnr, edges, *, noise=5.0):
    return FilterScore(name, 4.0, noise, psnr, edges, 0.1)


def test_all_edges_of_the_truth_itself_are_kept():
    assert edges_kept(plain_room(), plain_room()) == pytest.approx(1)


def test_half_the_contrast_is_half_the_edges():
    room = plain_room() // 2 * 2
    assert edges_kept(room, room // 2) == pytest.approx(0.5, abs=0.01)


def test_noise_makes_no_edges_and_blur_takes_them():
    room = plain_room()
    assert edges_kept(room, noisy(room, 10)) == pytest.approx(1, abs=0.02)
    kept = [edges_kept(room, cv2.GaussianBlur(room, (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    assert kept == sorted(kept, reverse=True)
    assert kept[-1] < 0.5


def test_a_flat_picture_has_no_edges_to_lose():
    flat = np.full((40, 60, 3), 128, np.uint8)
    assert edges_kept(flat, noisy(flat, 5)) == 1


def test_halving_halves_independent_noise():
    flat = np.full((200, 300, 3), 128, np.uint8)
    assert filter_comparison.halve(noisy(flat, 10)).std() == pytest.approx(5, rel=0.05)


def test_the_measured_level_is_compared_too_unless_it_is_one_of_the_others():
    assert filter_comparison.levels_with(7.04) == (3.0, 5.0, 7.0, 10.0, 15.0, 20.0)
    assert filter_comparison.levels_with(5.2) == filter_comparison.LEVELS
    assert filter_comparison.levels_with(0.2) == filter_comparison.LEVELS


def test_every_filter_is_scored_at_every_level_and_each_run_is_counted():
    ran = []
    levels = (5.0, 15.0)
    scores = filter_comparison.score_filters(
        [plain_room()[90:150, 40:140]], levels, on_run=lambda: ran.append(1))
    assert len(ran) == len(scores) == len(levels) * len(filter_comparison.VARIANTS)
    names = {one.filter for one in scores}
    assert {"none", "joint", "bilateral"} == names
    untouched = [one for one in scores if one.filter == "none"]
    for one, level in zip(untouched, levels, strict=True):
        assert one.psnr_db == pytest.approx(20 * np.log10(255 / level), abs=0.3)
    joint = [one for one in scores if one.filter == "joint"]
    assert all(filter_comparison.gain_db(scores, one) > 1 for one in joint)


def test_the_same_noise_is_added_every_time():
    scores = [
        [(one.psnr_db, one.edges_kept) for one in filter_comparison.score_filters(
            [plain_room()[90:150, 40:140]], (10.0,), on_run=lambda: None)]
        for _ in range(2)]
    assert scores[0] == scores[1]


def test_the_best_is_the_closest_that_keeps_the_edges():
    scores = [
        score("none", 34, 1.0), score("joint", 39, 0.97), score("bilateral", 40, 0.9),
        score("none", 24, 1.0, noise=15.0)]
    assert filter_comparison.best(scores, 5.1).filter == "joint"
    assert filter_comparison.gain_db(scores, scores[1]) == 5


def test_doing_nothing_can_be_the_best():
    scores = [score("none", 45, 1.0), score("joint", 44, 0.99)]
    assert filter_comparison.best(scores, 5).filter == "none"


# ---- the command ----

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
