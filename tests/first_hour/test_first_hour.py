"""The four ways that the README begins with, as a new user types them; each says what comes next.

Sizes are small: what is tested is that every step works, and that the next one is named.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.commands import budget
from recon_cli.time_estimate import COSTS, Cost

pytestmark = pytest.mark.integration

FRAMES = ("--frames", 16, "--set", "ingest.max_size=320")
SMALL = ("--set", "sfm.max_features=1500", "--set", "train.iterations=40",
         "--set", "train.max_size=96", "--set", "train.densify_every=10", "--threads", "2")


def recon(folder: Path, *words: object, code: int = 0) -> str:
    """Returns what a command prints that is typed in a folder."""
    printed = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        assert main([*map(str, words)]) == code
    return printed.getvalue()


def next_words(printed: str) -> list[str]:
    """The command that is named at the end, without `recon`."""
    line = next(line for line in printed.splitlines() if line.startswith("next:"))
    return line.partition("recon ")[2].partition(" or recon ")[0].split()


@pytest.fixture(autouse=True)
def _workspace_in_the_folder(monkeypatch):
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory, sample_video):
    """A folder in which somebody has typed one command about a video."""
    folder = tmp_path_factory.mktemp("video")
    words = ["run", sample_video, *FRAMES, "--title", "Our room", *SMALL]
    done = subprocess.run(
        [sys.executable, "-m", "recon_cli", *map(str, words)], cwd=folder, text=True,
        capture_output=True, check=False, env={**os.environ, "RECON_WORKSPACE": ""})
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_one_command_makes_a_page_of_a_video(filmed):
    folder, printed = filmed
    named = {line.split(":")[0]: line.split()[1] for line in printed.splitlines()
             if line.split(":")[0] in ("scene", "page", "report")}
    assert named.keys() == {"scene", "page", "report"}
    assert all((folder / path).is_file() for path in named.values())
    assert "<title>Our room</title>" in (folder / named["page"]).read_text(encoding="utf-8")
    assert (folder / named["page"]).with_suffix(".jpg").is_file()


def test_what_is_named_next_after_a_video_works(filmed):
    folder, printed = filmed
    words = next_words(printed)
    assert words[:2] == ["render", "--tour"]
    recon(folder, *words, "--seconds", 0.2, "--fps", 10)
    assert (folder / "walk.mp4").stat().st_size > 1000


def test_the_same_command_again_finds_everything_done(filmed, sample_video):
    folder, _ = filmed
    printed = recon(folder, "run", sample_video, *FRAMES, "--title", "Our room", *SMALL)
    assert printed.count("is up to date") == 9  # the stages, and the page


def test_a_time_for_the_whole_run_is_a_choice_that_is_kept(tmp_path, sample_video, monkeypatch):
    # without these seconds put aside for scores, and for training at least, it takes a minute
    monkeypatch.setitem(COSTS, "scores", Cost(1.0))
    monkeypatch.setattr(budget, "_LEAST_TRAINING", 1.0)
    words = ["run", sample_video, *FRAMES, "--minutes", 0.4, "--set", "sfm.max_features=1500",
             "--set", "train.max_size=96"]
    recon(tmp_path, *words)
    chosen = json.loads((tmp_path / "workspace" / "budget.json").read_text())
    assert chosen["train_minutes"] > 0
    assert "is up to date" in recon(tmp_path, *words)
    assert json.loads((tmp_path / "workspace" / "budget.json").read_text()) == chosen


def test_a_data_set_with_poses(tmp_path):
    make_replica(tmp_path / "office0", frames=8, tests=2)
    printed = recon(tmp_path, "run", "office0", "--set", "train.iterations=100", "--set",
                    "train.max_gaussians=300", "--set", "train.validation=0", "--no-prune")
    # its one colour is fitted so well that the rounding of a page costs many dB, which 8 bits hide
    assert next_words(printed)[:2] == ["render", "--tour"]
    assert (tmp_path / "workspace" / "export" / "splats.html").is_file()
    recon(tmp_path, "run", "--format", "html", "--set", "export.max_loss=0.3", "--set",
          "train.iterations=100", "--set", "train.max_gaussians=300", "--set",
          "train.validation=0", "--no-prune", code=5)


def test_a_server_with_many_captures_one_of_which_is_damaged(tmp_path, sample_video):
    (tmp_path / "good.mp4").symlink_to(sample_video)
    (tmp_path / "bad.mp4").write_bytes(b"not a video")
    printed = recon(tmp_path, "batch", "good.mp4", "bad.mp4", "--out", "scenes", "--jobs", 1,
                    "--set", "ingest.frames=16", "--set", "ingest.max_size=320", *SMALL, code=5)
    record = json.loads((tmp_path / "scenes" / "batch.json").read_text())
    ended = {one["capture"]: one["exit_code"] for one in record["captures"]}
    assert ended["good"] == 0
    assert ended["bad"] == 3
    words = next_words(printed)
    assert words[0] == "view"
    recon(tmp_path, "status", *words[1:])


def test_a_splat_file_of_another_program(filmed, tmp_path):
    folder, _ = filmed
    recon(folder, "export", "--format", "spz")
    (folder / "workspace" / "export" / "splats.spz").rename(tmp_path / "scene.spz")
    printed = recon(tmp_path, "import", "scene.spz")
    assert next_words(printed) == ["view"]
    recon(tmp_path, "export", "--format", "html")
    assert (tmp_path / "workspace" / "export" / "splats.html").is_file()
