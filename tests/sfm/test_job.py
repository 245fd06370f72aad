from dataclasses import replace
from pathlib import Path

from recon_cli.scene.camera import Lens
from recon_cli.sfm.job import CameraGroup, Job
from recon_cli.sfm.step_log import STEPS


def job(count, pairs="auto"):
    return Job(
        frames=Path("/in/frames"), denoised=Path("/in/denoised"), out=Path("/out"),
        groups=(CameraGroup(tuple(f"{index:06d}.png" for index in range(count)), 600, 340),),
        masks=None, poses=None, pose_use="keep", given_points=False, pairs=pairs,
        max_features=2048, min_registered=0.5, accept_weak=False,
        gravity=True, scale_between=None,
        max_minutes=1.0,
        seed=0, threads=2, sharpness={"000000.png": 12.5}, times={"000000.png": 0.25})


def test_what_is_written_is_read_back(tmp_path):
    lens = Lens("PINHOLE", 80, 60, (70.0, 71.0, 40.5, 30.0))
    told = replace(job(4), masks=Path("/in/masks"), poses=Path("/in/poses.json"), groups=(
        CameraGroup(("a.png", "c.png"), 600, 340, focal_px=812.5),
        CameraGroup(("b.png",), 80, 60, lens=lens)))
    assert told.names == ("a.png", "b.png", "c.png")
    told.write(tmp_path / "job.json")
    assert Job.read(tmp_path / "job.json") == told


def test_poses_and_points_that_are_kept_leave_nothing_to_be_found():
    lens = Lens("PINHOLE", 80, 60, (70.0, 71.0, 40.5, 30.0))
    group = replace(job(4).groups[0], lens=lens)
    given = replace(
        job(4), poses=Path("/in/poses.json"), given_points=True, groups=(group,))
    assert given.steps == ("model", "sparse", "undistorted")
    assert replace(given, pose_use="refine").steps == STEPS
    assert replace(given, given_points=False).steps == STEPS
    assert replace(given, groups=(replace(group, lens=None),)).steps == STEPS


def test_poses_that_are_ignored_are_not_known():
    given = replace(job(4), poses=Path("/in/poses.json"), given_points=True)
    assert given.known_poses
    assert not replace(given, pose_use="ignore").known_poses
    assert replace(given, pose_use="ignore").steps == STEPS
