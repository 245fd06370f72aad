"""Trainings of the tiny scene that tests of several files start from: made once, never written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import tiny_stages

from recon_cli.context import StageInputs

BuildOnce = Callable[[str, Callable[[Path], object]], Path]


def finished(folder: Path, *names: str) -> StageInputs:
    """The folders of finished stages."""
    return StageInputs({name: folder / name for name in ("ingest", "place", *names)})


@pytest.fixture(scope="session")
def tiny_pruned(build_once: BuildOnce) -> StageInputs:
    """ingest, sfm, and a finished train and prune."""
    return finished(build_once("tiny-pruned", tiny_stages.pruned), "train", "prune")


@pytest.fixture(scope="session")
def tiny_learnt(build_once: BuildOnce) -> StageInputs:
    """ingest, sfm, and a short train with harmonics that show."""
    return finished(
        build_once("tiny-learnt", lambda to: tiny_stages.trained(to, tiny_stages.LEARNT)), "train")
