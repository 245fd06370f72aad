"""Stages on a disk that fills up: exit code 7, nothing lost, and the same bytes once there is room.

Two ways to fill it: a limit on the size of a file, which needs no rights, and a small file system,
which has to be mounted.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from recon_cli.errors import ExitCode

resource = pytest.importorskip("resource")
pytestmark = pytest.mark.integration

SETTINGS = """
[ingest]
frames = 12
max_size = 240
[sfm]
max_features = 800
accept_weak = true
min_registered = 0.3
[train]
iterations = 20
max_size = 64
max_gaussians = 2000
background = "off"
stereo = "off"
checkpoint_every = 5
"""
RESULTS = {"sfm": "place/sparse/points3D.bin", "train": "train/splats.ply"}


def recon(*words: object, largest: int | None = None) -> subprocess.CompletedProcess[str]:
    """Runs a command with a limit on the bytes of a file."""
    def limit() -> None:
        if largest is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    return subprocess.run(
        [sys.executable, "-m", "recon_cli", *map(str, words)], preexec_fn=limit, text=True,
        capture_output=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"})


def run(stage: str, workspace: Path, largest: int | None = None) -> tuple[int, str]:
    done = recon(stage, "-w", workspace, "--threads", 1, largest=largest)
    return done.returncode, done.stderr


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, sample_video: Path) -> Path:
    """A workspace with room for everything."""
    workspace = tmp_path_factory.mktemp("disk") / "workspace"
    workspace.mkdir()
    (workspace / "recon.toml").write_text(SETTINGS, encoding="utf-8")
    for words in (["ingest", sample_video], ["sfm"], ["train"]):
        done = recon(*words, "-w", workspace, "--threads", 1)
        assert done.returncode == 0, done.stderr
    return workspace


def unfinished(finished: Path, target: Path, stage: str) -> Path:
    """Copies a workspace up to a stage."""
    shutil.copytree(finished, target)
    for name in ("train", "place", "sfm")[:1 if stage == "train" else 3]:
        shutil.rmtree(target / name)
    return target


def check_refused(code: int, said: str) -> None:
    assert code == ExitCode.WORKSPACE, said
    assert said.count("error:") == said.count("hint:") == 1
    assert "Traceback" not in said
    assert "Logging error" not in said
    assert "bug" not in said


@pytest.mark.parametrize(("stage", "limits"), [
    ("sfm", (20_000, 200_000, 600_000)), ("train", (2_000, 20_000, 100_000))])
def test_files_that_may_not_grow_are_said_and_the_rest_is_done_later(
    finished, tmp_path, stage, limits
):
    workspace = unfinished(finished, tmp_path / "w", stage)
    for largest in limits:
        check_refused(*run(stage, workspace, largest))
    code, said = run(stage, workspace)
    assert code == 0, said
    path = RESULTS[stage]
    assert (workspace / path).read_bytes() == (finished / path).read_bytes()


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """Yields a file system of its own; skips where none may be mounted."""
    folder.mkdir()
    if shutil.which("mount") is None or subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200m", "tmpfs", folder], check=False,
        capture_output=True,
    ).returncode:
        pytest.skip("no file system may be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def resize(folder: Path, free: int) -> None:
    """Leaves a file system so many free bytes."""
    stat = os.statvfs(folder)
    size = (stat.f_blocks - stat.f_bfree) * stat.f_frsize + free
    subprocess.run(["mount", "-o", f"remount,size={size}", folder], check=True)


@pytest.mark.parametrize(("stage", "spaces"), [
    ("sfm", (8_000, 400_000, 1_000_000)), ("train", (8_000, 60_000, 150_000))])
def test_a_disk_that_fills_up_is_said_and_the_rest_is_done_later(
    finished, tmp_path, stage, spaces
):
    with small_disk(tmp_path / "disk") as disk:
        workspace = unfinished(finished, disk / "w", stage)
        for free in spaces:
            shutil.rmtree(workspace / ".partial", ignore_errors=True)
            resize(disk, free)
            code, said = run(stage, workspace)
            check_refused(code, said)
            assert "The disk is full" in said
        resize(disk, 200_000_000)
        code, said = run(stage, workspace)
        assert code == 0, said
        path = RESULTS[stage]
        assert (workspace / path).read_bytes() == (finished / path).read_bytes()
