"""The sample video all the way through the command line, and killed in every stage on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from recon_cli.splats.ply import read_ply

pytestmark = pytest.mark.integration

SETTINGS = """
[ingest]
frames = 16
max_size = 320
[sfm]
max_features = 1500
[train]
iterations = 40
max_size = 96
densify_every = 10
checkpoint_every = 5
"""
STAGES = ("ingest", "denoise", "sfm", "place", "train", "prune", "evaluate", "export")
VERBS = {"evaluate": "eval", "place": "sfm"}
EVERY_LINE = """
import json, sys
from recon_cli.cli import main
for words in json.loads(sys.argv[1]):
    if main(words):
        sys.exit(f"recon {words} failed")
"""


def command(*words: object) -> list[str]:
    return [sys.executable, "-m", "recon_cli", *map(str, words)]


def environment() -> dict[str, str]:
    # one thread: what is compared to the bit must not depend on how busy the machine is
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def recon(*words: object) -> str:
    done = subprocess.run(command(*words), capture_output=True, text=True, env=environment(),
                          check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def make_workspace(folder: Path) -> Path:
    folder.mkdir()
    (folder / "recon.toml").write_text(SETTINGS, encoding="utf-8")
    return folder


def words_for(stage: str, workspace: Path, video: Path) -> list[object]:
    words: list[object] = [VERBS.get(stage, stage)]
    if stage == "ingest":
        words.append(video)
    if stage == "prune":
        words += ["--at", "mid"]
    return [*words, "-w", workspace, *(["--threads", 1])] if stage != "export" else [
        *words, "-w", workspace]


@pytest.fixture(scope="module")
def finished(tmp_path_factory, sample_video):
    """A workspace that nothing interrupted."""
    workspace = make_workspace(tmp_path_factory.mktemp("whole") / "workspace")
    assert start_verbs(STAGES, workspace, sample_video).wait() == 0
    return workspace


@pytest.mark.floors
def test_the_sample_video_becomes_a_scene_with_a_table(finished):
    status = json.loads(recon("status", "--json", "-w", finished))
    assert {row["state"] for row in status["stages"]} == {"fresh"}
    metrics = json.loads((finished / "evaluate" / "metrics.json").read_text(encoding="utf-8"))
    base, pruned = metrics["models"]["base"], metrics["models"]["pruned"]
    assert pruned["gaussians"] < base["gaussians"]
    assert base["psnr_db"] > 14  # forty steps at 96 pixels: a room, not yet a good one
    listed = {row["name"]: row for row in status["stages"]}
    assert len(read_ply(finished / "export" / "splats.ply")) == (
        listed["export"]["summary"]["gaussians"]) >= pruned["gaussians"]  # and the backdrop
    frames = json.loads((finished / "ingest" / "frames.json").read_text(encoding="utf-8"))
    held_out = sorted(f["name"] for f in frames["frames"] if f["held_out"])
    scored = [view["name"] for view in base["views"]]
    assert sorted(scored + metrics["unregistered_test"]) == held_out


def test_a_second_run_has_nothing_to_do(finished):
    before = (finished / "train" / "manifest.json").stat().st_mtime_ns
    recon("train", "-w", finished, "--threads", 1)
    assert (finished / "train" / "manifest.json").stat().st_mtime_ns == before


def test_killed_in_every_stage_it_ends_with_the_same_scene(finished, tmp_path, sample_video):
    workspace = make_workspace(tmp_path / "workspace")
    killed = kill_in_every_stage(workspace, sample_video)
    assert {"ingest", "sfm", "train", "prune"} <= set(killed)
    for path in ("train/splats.ply", "prune/splats.ply", "export/splats.ply"):
        assert (workspace / path).read_bytes() == (finished / path).read_bytes(), path
    scores = [json.loads((w / "evaluate" / "metrics.json").read_text(encoding="utf-8"))
              for w in (workspace, finished)]
    assert scores[0]["models"]["base"]["views"] == scores[1]["models"]["base"]["views"]


def kill_in_every_stage(workspace: Path, video: Path) -> list[str]:
    """Runs all verbs; kills them with -9 once in each stage, begins again, and names the stages.

    A stage that ends before it is caught at work is left out.
    """
    killed = []
    process = start_verbs(STAGES, workspace, video)
    for at, stage in enumerate(STAGES):
        partial = workspace / ".partial" / stage
        while not (workspace / stage / "manifest.json").exists():
            # two files: it has begun to leave something, and is not yet done
            if partial.is_dir() and sum(1 for p in partial.rglob("*") if p.is_file()) >= 2:
                process.send_signal(signal.SIGKILL)
                process.wait()
                if not (workspace / stage / "manifest.json").exists():
                    killed.append(stage)
                process = start_verbs(STAGES[at:], workspace, video)
                break
            assert process.poll() is None, stage
            time.sleep(0.002)
    assert process.wait() == 0
    return killed


def start_verbs(stages: Sequence[str], workspace: Path, video: Path) -> subprocess.Popen[bytes]:
    """Starts the verbs of some stages, one after the other in one process: it imports once."""
    lines = [[str(word) for word in words_for(stage, workspace, video)] for stage in stages]
    return subprocess.Popen(
        [sys.executable, "-c", EVERY_LINE, json.dumps(lines)], env=environment())
