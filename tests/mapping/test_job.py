from dataclasses import replace
from pathlib import Path

import pytest

from recon_cli.mapping.job import CameraGroup, Job
from recon_cli.scene.lens import Lens


def job(count, pairs="auto"):
    return Job(
        frames=Path("/in/frames"), denoised=Path("/in/denoised"), out=Path("/out"),
        groups=(CameraGroup(tuple(f"{index:06d}.png" for index in range(count)), 600, 340),),
        masks=None, poses=None, pose_use="keep", pairs=pairs,
        max_features=2048, min_registered=0.5, seed=0,
        threads=2)


def test_what_is_written_is_read_back(tmp_path):
    lens = Lens("PINHOLE", 80, 60, (70.0, 71.0, 40.5, 30.0))
    told = replace(job(4), masks=Path("/in/masks"), poses=Path("/in/poses.json"), groups=(
        CameraGroup(("a.png", "c.png"), 600, 340, focal_px=812.5),
        CameraGroup(("b.png",), 80, 60, lens=lens)))
    assert told.names == ("a.png", "b.png", "c.png")
    told.write(tmp_path / "job.json")
    assert Job.read(tmp_path / "job.json") == told


@pytest.mark.parametrize(("count", "exhaustive"), [(100, True), (101, False)])
def test_auto_is_exhaustive_up_to_a_hundred_images(count, exhaustive):
    assert job(count).exhaustive is exhaustive


def test_a_named_way_of_pairing_is_taken():
    assert job(300, "exhaustive").exhaustive
    assert not job(5, "sequential").exhaustive


def test_exhaustive_pairs_are_counted():
    assert job(100).pair_count == 4950


def test_sequential_pairs_are_neighbours_and_powers_of_two():
    # 20 images: 19 + 18 + ... + 10 neighbours at 1 to 10, and 4 pairs that are 16 apart.
    assert job(20, "sequential").pair_count == sum(range(10, 20)) + 4
