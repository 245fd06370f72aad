"""A workspace of fake stages that are all fresh, copied for each test."""


import shutil
from pathlib import Path

import fake_stages
import pytest
from fake_stages import NAMES, bring, job_at

from recon_cli.pipeline.plan import Job


@pytest.fixture(autouse=True)
def _no_actions() -> None:
    fake_stages.actions.clear()
    fake_stages.ran.clear()


@pytest.fixture(scope="module")
def _finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    (folder / "room.mp4").write_text("a video")
    bring(job_at(folder / "ws"), *NAMES, video=folder / "room.mp4")
    return folder


@pytest.fixture
def folder(_finished: Path, tmp_path: Path) -> Path:
    """A folder that holds room.mp4 and a workspace ws in which every stage is fresh."""
    shutil.copytree(_finished, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def job(folder: Path) -> Job:
    """A job whose stages are all fresh; its input is the video in `folder`."""
    job = job_at(folder / "ws")
    bring(job, "ingest", video=folder / "room.mp4")
    fake_stages.ran.clear()
    return job
