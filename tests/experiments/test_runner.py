"""One run on a tiny scene, and the scenes that runs are made on; times are never asserted."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import pytest
from facts import raises
from posed_sets import make_replica
from tiny_scene import make_inputs

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import ConfigError
from recon_cli.experiments import clock as clocks
from recon_cli.experiments.clock import Clock
from recon_cli.experiments.runner import run_trial
from recon_cli.experiments.scenes import (
    ExperimentScene,
    SceneFolders,
    check_scenes,
    load_for_training,
)
from recon_cli.experiments.variants import BUDGET, PAPER, REFERENCE, TrainingRun
from recon_cli.io.training_scene import PlacedCapture

BASE = RunConfig(iterations=1, max_size=48, max_gaussians=90, densify_every=10, validation=0.2)


def nothing() -> None:
    """Reports to nobody."""


@pytest.fixture
def tiny(tmp_path: Path) -> ExperimentScene:
    place = SceneFolders("tiny", PlacedCapture.read(make_inputs(tmp_path).folders))
    return load_for_training(place, "validation", BASE, StageContext(backend="numba"))


def test_the_clock_stands_still_in_its_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    walls, cpus = iter([1.0, 3.0, 10.0, 11.0]), iter([5.0, 9.0, 20.0, 20.5])
    monkeypatch.setattr(clocks.time, "perf_counter", lambda: next(walls))
    monkeypatch.setattr(clocks.time, "process_time", lambda: next(cpus))
    clock = Clock("cpu")
    with clock.pause():  # from 3 to 10, and from 9 to 20
        pass
    assert clock.seconds() == (3.0, 4.5)


@pytest.mark.integration
def test_looking_changes_nothing_about_a_run(tiny: ExperimentScene) -> None:
    run = TrainingRun(REFERENCE, BASE, 40, 0)
    often = run_trial(tiny, run, range(0, 41, 5), on_step=nothing)
    once = run_trial(tiny, run, (), on_step=nothing)
    assert [one.iteration for one in often] == list(range(0, 41, 5))
    assert len(once) == 1
    assert dataclasses.replace(once[0], seconds=0, cpu_seconds=0) == dataclasses.replace(
        often[-1], seconds=0, cpu_seconds=0)
    assert often[-1].psnr_db > often[0].psnr_db + 3
    assert all(a.seconds <= b.seconds for a, b in itertools.pairwise(often))
    assert often[-1].bytes > 248 * often[-1].gaussians  # 62 float32 each, and a header


def test_every_step_is_reported_once(tiny: ExperimentScene) -> None:
    steps: list[int] = []
    run_trial(tiny, TrainingRun(PAPER, BASE, 30, 0), (7,), on_step=lambda: steps.append(1))
    assert len(steps) == 30


@pytest.mark.integration
def test_the_arm_of_the_paper_removes_its_share_at_two_thirds(tiny: ExperimentScene) -> None:
    assert PAPER.prune
    assert (PAPER.prune.config.ratio, PAPER.prune.config.score) == (0.6, "paper")
    points = {one.iteration: one for one in run_trial(
        tiny, TrainingRun(PAPER, BASE, 60, 0), (40, 41, 60), on_step=nothing)}
    before, after = points[40].gaussians, points[41].gaussians
    assert after == before - int(0.6 * before)
    assert points[60].gaussians == after  # nothing grows back
    other = run_trial(tiny, TrainingRun(REFERENCE, BASE, 60, 0), (40,), on_step=nothing)
    assert other[0].psnr_db == points[40].psnr_db  # the same run up to there


def test_a_run_trains_on_no_view_that_is_scored(tiny: ExperimentScene) -> None:
    task = tiny.task(TrainingRun(BUDGET, BASE, 5, 0))
    assert len(task.train) == len(tiny.scene.train)
    assert task.validation == []
    assert {view.name for view in tiny.scene.validation}.isdisjoint(
        view.name for view in tiny.scene.train)


# ---- scenes ----

def test_a_digest_is_of_what_a_scene_holds(tmp_path: Path) -> None:
    one = SceneFolders("one", PlacedCapture.read(make_inputs(tmp_path / "a").folders))
    two = SceneFolders("two", PlacedCapture.read(make_inputs(tmp_path / "b").folders))
    assert one.digest == two.digest
    image = tmp_path / "b" / "place" / "undistorted" / "denoised" / "000003.png"
    image.write_bytes(image.read_bytes() + b"\0")
    assert SceneFolders("two", two.capture).digest != one.digest


def test_two_scenes_of_one_name_are_refused(tmp_path: Path) -> None:
    for parent in ("a", "b"):
        make_replica(tmp_path / parent / "room")
    with raises(ConfigError, "both", "called"):
        check_scenes([tmp_path / "a" / "room", tmp_path / "b" / "room"])
