"""`recon bench train`: curves, recipes and the command; times are never asserted."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from posed_sets import make_replica
from tiny_scene import make_inputs

from recon_cli.cli import main
from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.experiments import outputs, runner
from recon_cli.experiments import recipe_benchmark as module
from recon_cli.experiments.instruments import Host
from recon_cli.experiments.recipe_benchmark import (
    CurvesResult,
    RecipeRequest,
    common_target,
    median_cell,
    score_steps,
    seconds_to,
)
from recon_cli.experiments.runner import CurvePoint, Record, Runner, SceneRuns
from recon_cli.experiments.scenes import SceneFolders, load_for_training
from recon_cli.experiments.variants import (
    REFERENCE,
    Variant,
)
from recon_cli.progress import NullProgress

Said = pytest.CaptureFixture[str]
BASE = RunConfig(iterations=1, max_size=48, max_gaussians=90, densify_every=10, validation=0.2)


def point(seconds: float, psnr_db: float) -> CurvePoint:
    return CurvePoint(
        int(100 * seconds), seconds, 2 * seconds, 1000, 250_000, psnr_db, psnr_db / 40)


# ---- curves ----

def test_a_target_is_reached_on_the_line_between_two_points() -> None:
    curve = [point(0, 10), point(2, 20), point(3, 18), point(5, 30)]
    assert seconds_to(curve, 15, "seconds") == pytest.approx(1.0)
    assert seconds_to(curve, 15, "cpu_seconds") == pytest.approx(2.0)
    assert seconds_to(curve, 20, "seconds") == 2.0
    assert seconds_to(curve, 19, "seconds") == pytest.approx(1.8)  # not after the dip
    assert seconds_to(curve, 24, "seconds") == pytest.approx(4.0)
    assert seconds_to(curve, 5, "seconds") == 0.0
    assert seconds_to(curve, 30.1, "seconds") is None


def test_all_runs_reach_the_common_target() -> None:
    assert common_target([[point(0, 10), point(1, 20.19)], [point(0, 25)]]) == pytest.approx(20.1)
    assert common_target([[point(0, -0.05)]]) == pytest.approx(-0.1)


def test_looks_are_evenly_spread_from_the_start_to_the_end() -> None:
    assert score_steps(100, 4) == (0, 25, 50, 75, 100)
    assert score_steps(3, 20) == (0, 1, 2, 3)


def test_a_median_says_how_many_runs_it_is_of() -> None:
    assert median_cell([1.0, 2.0, 3.0]) == "2 (1)"
    assert median_cell([1.0, None, 3.0]) == "2 (1), 2 of 3"
    assert median_cell([1.0, None]) == "-"


# ---- the command ----

def test_the_command_writes_curves_tables_and_the_picture(tmp_path: Path, capsys: Said) -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    make_replica(tmp_path / "room", frames=8, tests=2)
    text = tmp_path / "page.md"
    text.write_text(f"{outputs.BEGIN}\n{outputs.END}\n")
    words = ["bench", "train", "--recipes", "reference,paper", "--iterations", "20", "--seeds", "2",
             "--max-size", "32", "--max-gaussians", "200", "--threads", "1", "--device", "cpu",
             "--out", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.svg"),
             "--markdown", str(text), "--target-db", "5", "--target-db", "90",
             "--scenes", str(tmp_path / "room")]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "room: 1 validation views at 32x24" in out
    assert "s to 5 dB" in out
    record = json.loads((tmp_path / "a.json").read_text())
    assert (record["schema"], record["version"]) == ("recon-bench-train", 1)
    recipe = record["scenes"]["room"]["recipes"]["paper"]
    assert recipe["prune"]["ratio"] == 0.6
    assert recipe["seconds_to"]["90"] == [None, None]
    assert len(recipe["seconds_to"]["5"]) == 2
    for number, run in enumerate(recipe["runs"]):
        assert run["seed"] == number
        assert [one["iteration"] for one in run["points"]] == list(range(21))
        assert run["points"][-1].keys() == {item.name for item in dataclasses.fields(CurvePoint)}
    assert "### room:" in text.read_text()
    assert (tmp_path / "a.svg").stat().st_size > 5000
    assert {path.name for path in tmp_path.iterdir()} == {"a.json", "a.svg", "page.md", "room"}


@pytest.mark.parametrize(("words", "code", "said"), [
    ([], 2, "No scene was given"),
    (["--scenes", "nothing"], 3, "does not exist"),
    (["--scenes", "empty"], 3, "neither a workspace with cameras nor a data set"),
    (["--scenes", "room", "--recipes", "other"], 2, "There is no recipe 'other'"),
    (["--scenes", "room", "--iterations", "5", "--seconds", "5"], 2, "exclude each other"),
    (["--scenes", "room", "--set", "export.model=base"], 2, "has no effect here"),
    (["--scenes", "room", "--set", "train.seed=5"], 2, "has no effect here"),
    (["--scenes", "room", "--plot", "a.pdf"], 2, ".png or .svg"),
    (["--scenes", "room", "--json", "none/a.json"], 3, "does not exist"),
])
def test_what_cannot_be_done_is_refused_before_training(
    words: list[str], code: int, said: str, tmp_path: Path, capsys: Said,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "measure", lambda *_: pytest.fail("ran"))
    (tmp_path / "empty").mkdir()
    make_replica(tmp_path / "room")
    assert main(["bench", "train", *words]) == code
    assert said in capsys.readouterr().err


def test_a_workspace_without_cameras_is_refused_with_what_to_type(
    tmp_path: Path, capsys: Said
) -> None:
    make_replica(tmp_path / "room", frames=8)
    assert main(["ingest", str(tmp_path / "room"), "-w", str(tmp_path / "ws")]) == 0
    capsys.readouterr()
    assert main(["bench", "train", "--scenes", str(tmp_path / "ws")]) == 4
    err = capsys.readouterr().err
    assert "sfm" in err
    assert f"-w {tmp_path / 'ws'}" in err


@pytest.mark.parametrize("words", [["--quick", "train"], ["--scene", "small", "train"], ["none"]])
def test_options_of_the_rasterizers_mean_nothing_to_training(
    words: list[str], capsys: Said
) -> None:
    assert main(["bench", *words]) == 2
    assert "error: " in capsys.readouterr().err


def test_seconds_become_steps_by_a_pilot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "run_pilot", lambda *_: point(4.0, 20.0))
    folders = SceneFolders("tiny", make_inputs(tmp_path))
    tiny = load_for_training(folders, "validation", BASE, StageContext(backend="numba"))
    a_step = Runner(BASE, NullProgress()).pilot_seconds(tiny, [REFERENCE])["reference"]
    request = RecipeRequest(scenes=(), seeds=1, base=BASE, recipes=(REFERENCE,), seconds=10.0)
    assert request.steps(a_step) == round(runner.PILOT_STEPS * 10 / 4)
    given = dataclasses.replace(request, iterations=77, seconds=None)
    assert given.steps(a_step) == 77


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    records = tuple(Record((point(0, 10), point(1, 20 + seed)), "") for seed in range(2))
    recipes = tuple(Variant(name, name) for name in ("one", "two"))
    scene = SceneRuns(3, 64, 48, {module.ALL: dict.fromkeys(("one", "two"), records)})
    host = Host("A CPU", 2, 2, 16, "cpu", {"torch": "2", "numpy": "2", "python": "3"})
    result = CurvesResult(host, 2, BASE, (), recipes, {"a": scene, "b": scene})
    module.draw(result, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000
    assert module.tables(result)[0].rows[0][0] == "one"
    assert "s to 20 dB" in module.tables(result)[0].headings
