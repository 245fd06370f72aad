"""Stages from Python: their options, what they return, and that commands see the same results."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import fake_stages
import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from tiny_room import TINY, write_options

from recon_cli import cli
from recon_cli.api import (
    ConfigError,
    FormatError,
    InputError,
    StageError,
    TrainCallback,
    TrainConfig,
    Workspace,
    evaluate,
    read_cameras,
    render,
    workspace,
)
from recon_cli.workspace import layout


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Workspace:
    """A workspace whose stages write a line each."""
    fake_stages.actions.clear()
    fake_stages.ran.clear()
    monkeypatch.setattr(workspace, "STAGES", fake_stages.TABLE)
    (tmp_path / "room.mp4").write_text("a video")
    return Workspace(tmp_path / "ws", settings={"compute": {"backend": "torch"}})


def config_of(opened: Workspace, stage: str) -> dict[str, object]:
    manifest = layout.Workspace(opened.path).manifest(stage)
    assert manifest is not None
    return manifest.key.config


@pytest.mark.integration
def test_each_method_runs_its_stage_and_what_that_needs(fakes: Workspace, tmp_path: Path) -> None:
    assert fakes.ingest(str(tmp_path / "room.mp4")).ran
    trained = fakes.train(iterations=7)  # denoise and sfm run first
    assert fake_stages.ran == ["ingest", "denoise", "sfm", "place", "train"]
    assert (trained.ran, trained.stage, trained.folder) == (True, "train", fakes.path / "train")
    assert config_of(fakes, "train")["iterations"] == 7
    assert not fakes.train(iterations=7).ran
    assert fakes.train(iterations=7, again=True).ran
    for method in (fakes.prune, fakes.evaluate, fakes.export):
        assert method().ran
    assert [stage.state for stage in fakes.status()[:7]] == ["fresh"] * 7


def test_keywords_win_over_a_config_which_wins_over_files(
    fakes: Workspace, tmp_path: Path
) -> None:
    fakes.ingest(tmp_path / "room.mp4")
    (fakes.path / "recon.toml").write_text("[train]\niterations = 5\nsh_degree = 2\n")
    fakes.train()
    assert (config_of(fakes, "train")["iterations"], config_of(fakes, "train")["sh_degree"]) == (
        5, 2)
    fakes.train(iterations=6)
    assert (config_of(fakes, "train")["iterations"], config_of(fakes, "train")["sh_degree"]) == (
        6, 2)
    config = TrainConfig(iterations=8)  # every field of it counts
    fakes.train(config=config, densify="reference")
    assert config_of(fakes, "train") == {**config.hashed_fields(), "densify": "reference"}
    Workspace(fakes.path, settings={"train": {"iterations": 9}}).train()
    assert config_of(fakes, "train")["iterations"] == 9


def test_an_option_that_does_not_exist_is_named_before_anything_is_made(fakes: Workspace) -> None:
    with raises(ConfigError, "train.iteratons") as caught:
        fakes.train(iteratons=3)
    assert_facts(caught.value.hint, "mean", "iterations")
    with raises(ConfigError, "iterations", "x"):
        fakes.train(iterations="x")
    for settings, facts in (({"trian": {}}, ["trian"]), ({"train": 3}, ["train", 3]),
                            ({"train": {"steps": 3}}, ["train.steps"])):
        with raises(ConfigError, *facts):
            Workspace(fakes.path, settings=settings)
    with pytest.raises(FormatError):
        fakes.ingest("/dev/null")
    assert not fakes.path.exists()


def test_errors_are_those_of_the_commands(fakes: Workspace) -> None:
    with raises(ConfigError, "ingest", "input"):
        fakes.ingest()
    with raises(StageError, "ingest", "missing") as caught:
        fakes.train()
    assert_facts(caught.value.hint, "recon ingest VIDEO")
    with raises(InputError, "held-out"):
        fakes.views("held-out")
    with raises(InputError, "small"):
        fakes.splats("small")


def test_notices_are_part_of_the_result_and_are_not_printed(
    fakes: Workspace, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fake_stages.actions["ingest"] = lambda *_: logging.getLogger("recon").warning("a dim video")
    assert fakes.ingest(tmp_path / "room.mp4").notices == ("a dim video",)
    assert capfd.readouterr() == ("", "")


@pytest.mark.integration
def test_a_capture_from_python_is_that_of_the_commands(
    sample_video: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    steps: list[int] = []

    class Counter(TrainCallback):
        def on_step(self, iteration: int, _splats: object) -> None:
            steps.append(iteration)

        def needs_step(self, iteration: int) -> bool:
            return iteration == 30

    threads = torch.get_num_threads()
    opened = Workspace(tmp_path / "ws", settings=TINY)
    ingested = opened.ingest(sample_video)
    assert len(ingested.frames) == 16
    assert all(path.is_file() for path in ingested.frames)
    assert set(ingested.held_out) < {path.name for path in ingested.frames}
    found = opened.sfm()
    assert found.points.shape == (found.summary.points, 3) == (*found.colors.shape,)
    assert list(found.cameras) == list(read_cameras(opened.path))
    trained = opened.train(callbacks=[Counter()])
    assert {30, 60} <= set(steps)
    assert len(trained.splats) == trained.summary.gaussians == trained.curve.gaussians[-1]
    assert trained.curve.iteration[-1] == 60
    pruned = opened.prune(ratio=0.5)
    assert len(pruned.splats) == -(-len(trained.splats) // 2)
    scored = opened.evaluate()
    views = opened.views("test")
    renders = [render(opened.splats("pruned"), view.camera).rgb for view in views]
    ours = evaluate(renders, [view.image for view in views])
    assert ours.psnr_db == pytest.approx(scored.metrics["pruned"].psnr_db, abs=1e-6)
    assert len(scored.renders("pruned")) == len(views)
    exported = opened.export(format="ply,spz")
    assert exported.ply.is_file()
    assert exported.files["spz"].is_file()
    assert opened.report().is_file()
    assert torch.get_num_threads() == threads
    assert capfd.readouterr() == ("", "")
    # the same by commands: the same results, and each takes those of the other for fresh
    write_options(tmp_path / "other")
    for stage in ("ingest", "denoise", "sfm", "place"):
        shutil.copytree(opened.path / stage, tmp_path / "other" / stage)
    at = ["-w", str(tmp_path / "other")]
    for command in (["ingest", str(sample_video)], ["train"], ["prune", "--ratio", "0.5"]):
        assert cli.main([*command, *at]) == 0
    for stage in ("ingest", "denoise", "sfm", "place"):
        name = f"{stage}/manifest.json"
        assert (tmp_path / "other" / name).read_bytes() == (opened.path / name).read_bytes()
    for stage in ("train", "prune"):
        name = f"{stage}/splats.ply"
        assert (tmp_path / "other" / name).read_bytes() == (opened.path / name).read_bytes()
    assert not Workspace(tmp_path / "other").prune(ratio=0.5).ran
    np.testing.assert_array_equal(Workspace(tmp_path / "other").splats("base").means,
                                  trained.splats.means)
