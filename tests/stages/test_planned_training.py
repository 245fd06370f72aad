"""Training whose length or count was left open: what is recorded, repeated, resumed, and borne."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import pytest
from facts import assert_facts, raises
from killed import Killed, kill_after
from tiny_scene import Shape, make_inputs

from recon_cli.config.stages import EvaluateConfig, PruneConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import TrainingError
from recon_cli.evaluation.scores import Metrics
from recon_cli.splats.ply import read_ply
from recon_cli.stages import evaluate, prune, train
from recon_cli.train import plan as planning
from recon_cli.train.fit import loop, train_data
from recon_cli.train.fit.train_data import estimate_memory

pytestmark = pytest.mark.integration

CONTEXT = StageContext(backend="numba")
OPEN = TrainConfig(minutes=0.02, densify_every=10, checkpoint_every=30)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    return make_inputs(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def done(inputs, tmp_path_factory):
    """A finished run of a fiftieth of a minute: its folder and its summary."""
    out = tmp_path_factory.mktemp("train")
    return out, train.run(OPEN, inputs, out, CONTEXT)


def run(config, inputs, out, ctx=CONTEXT):
    out.mkdir(exist_ok=True)
    return train.run(config, inputs, out, ctx)


def same_bytes(one, other):
    return all((one / name).read_bytes() == (other / name).read_bytes()
               for name in ("splats.ply", "mid.safetensors", "final.safetensors"))


def test_the_plan_is_recorded_with_what_it_was_made_from(done):
    out, summary = done
    plan = json.loads((out / "plan.json").read_text())
    assert plan["cost"]["costs"].keys() == {
        "step at 1/1", "step at 1/2", "report", "save"}
    assert plan["iterations"] == summary.planned_iterations >= 100
    assert plan["max_gaussians"] == summary.max_gaussians
    assert plan["seconds"] == summary.estimated_seconds
    assert summary.calibration_seconds > 0
    config = json.loads((out / "config.json").read_text())
    assert {name: config[name] for name in ("iterations", "max_gaussians", "max_size")} == {
        name: plan[name] for name in ("iterations", "max_gaussians", "max_size")}
    assert not list(out.glob("calibration*"))


def test_the_numbers_of_a_plan_repeat_the_run_to_the_byte(inputs, done, tmp_path):
    first, summary = done
    again = replace(
        OPEN, minutes=None, iterations=summary.planned_iterations,
        max_gaussians=summary.max_gaussians, max_size=summary.max_size, **summary.parts)
    run(again, inputs, tmp_path / "again")
    assert same_bytes(first, tmp_path / "again")


def test_an_interrupted_run_goes_on_by_its_recorded_plan(inputs, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        kill_after(60, patch)
        with pytest.raises(Killed):
            run(OPEN, inputs, out)
    recorded = (out / "plan.json").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(planning, "calibrate", None)  # would fail if it were called
        summary = run(OPEN, inputs, out)
    assert (out / "plan.json").read_bytes() == recorded
    whole = replace(
        OPEN, minutes=None, iterations=summary.planned_iterations,
        max_gaussians=summary.max_gaussians, max_size=summary.max_size, **summary.parts)
    run(whole, inputs, tmp_path / "whole")
    assert same_bytes(out, tmp_path / "whole")


def test_memory_that_is_short_lowers_the_cap_and_says_so(inputs, tmp_path, monkeypatch, caplog):
    needed = estimate_memory(views=9, width=48, height=36, gaussians=5500, fused=True)
    monkeypatch.setattr(train_data, "free_memory_bytes", lambda: needed.total)
    monkeypatch.setattr(planning, "useful_cap", lambda *_: 9000)
    summary = run(TrainConfig(iterations=2), inputs, tmp_path / "out")
    assert summary.max_gaussians == pytest.approx(5500, abs=10)
    assert_facts(caplog.text, "9,000")


def test_images_in_a_file_change_no_byte(inputs, done, tmp_path, monkeypatch):
    first, summary = done
    monkeypatch.setattr(train_data, "_IN_MEMORY", 0.0)
    monkeypatch.setattr(train_data, "SEGMENT", 3 * 48 * 36)
    opened = []

    def opening(ctx):
        opened.append(image_file(ctx))
        return opened[-1]

    image_file = train_data.image_file
    monkeypatch.setattr(train_data, "image_file", opening)
    again = replace(
        OPEN, minutes=None, iterations=summary.planned_iterations,
        max_gaussians=summary.max_gaussians, max_size=summary.max_size, **summary.parts)
    run(again, inputs, tmp_path / "again", replace(CONTEXT, scratch=tmp_path / "scratch"))
    assert opened
    assert same_bytes(first, tmp_path / "again")
    assert not list((tmp_path / "scratch").iterdir())


def test_less_memory_than_is_free_can_be_given(inputs, tmp_path):
    needed = estimate_memory(views=9, width=48, height=36, gaussians=5500, fused=True)
    config = TrainConfig(iterations=2, max_gaussians=6000, sh_degree=3)
    with raises(TrainingError, f"{needed.total / 1e6:,.0f} MB") as caught:
        run(config, inputs, tmp_path / "out", replace(CONTEXT, max_memory_bytes=needed.total))
    assert "--max-memory" in caught.value.hint


def test_a_count_at_its_cap_from_the_start_stays_there(inputs, tmp_path):
    summary = run(replace(OPEN, minutes=None, iterations=120, max_gaussians=20), inputs,
                  tmp_path / "out")
    assert (summary.initial_gaussians, summary.max_gaussians) == (20, 20)
    assert summary.gaussians <= 20


def test_the_shortest_time_gives_the_smallest_run_and_says_so(inputs, tmp_path, caplog):
    summary = run(
        replace(OPEN, minutes=0.01), inputs, tmp_path / "out", StageContext(backend="torch"))
    assert summary.iterations == 100
    assert_facts(caplog.text, "short")


def test_one_step_is_a_run(inputs, tmp_path):
    summary = run(TrainConfig(iterations=1, stereo="off"), inputs, tmp_path / "out")
    assert summary.iterations == 1
    assert len(read_ply(tmp_path / "out" / "splats.ply")) == summary.gaussians == 60


def test_a_large_image_among_small_ones_is_planned_for(tmp_path):
    shapes = (Shape(48, 36, 40.0), Shape(48, 36, 40.0), Shape(900, 700, 700.0))
    inputs = make_inputs(tmp_path, shapes)
    summary = run(replace(OPEN, minutes=0.05, max_size=900), inputs, tmp_path / "out")
    assert summary.iterations >= 100
    assert (900, 700) in summary.sizes


def test_one_view_to_train_on_is_too_few(inputs, tmp_path):
    folder = tmp_path / "ingest"
    shutil.copytree(inputs.folders["ingest"], folder)
    frames = json.loads((folder / "frames.json").read_text())
    for i, frame in enumerate(frames["frames"]):
        frame["held_out"] = i > 0
    (folder / "frames.json").write_text(json.dumps(frames))
    with raises(TrainingError, 1, "view") as caught:
        run(OPEN, StageInputs({**inputs.folders, "ingest": folder}), tmp_path / "out")
    assert "--holdout" in caught.value.hint


STOPPING = TrainConfig(iterations=160, max_gaussians=120, densify_every=10, checkpoint_every=7)


@pytest.fixture
def flat(monkeypatch):
    """Validation views that never change, looked at every four steps."""
    monkeypatch.setattr(loop, "report_every", lambda _: 4)
    monkeypatch.setattr(loop, "validation_psnr", lambda *_: 20.0)


@pytest.mark.usefixtures("flat")
def test_an_early_stop_is_recorded_and_pruning_follows_it(inputs, tmp_path):
    summary = run(STOPPING, inputs, tmp_path / "train")
    assert summary.stopped_early_at == 100
    assert summary.iterations == 160 - (128 - 100)
    rows = [json.loads(line) for line in
            (tmp_path / "train" / "log.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows if row.get("goes_on_at")] == [100]
    assert all(row["cpu_seconds"] >= 0 for row in rows)
    (tmp_path / "prune").mkdir()
    both = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    pruned = prune.run(PruneConfig(at="mid"), both, tmp_path / "prune", CONTEXT)
    assert pruned.iterations == summary.iterations
    assert pruned.recovery_steps == summary.iterations - 96


@pytest.mark.usefixtures("flat")
@pytest.mark.parametrize("steps", [91, 100, 140])
def test_a_killed_run_that_stops_early_ends_with_the_same_bytes(
    inputs, tmp_path, monkeypatch, steps
):
    run(STOPPING, inputs, tmp_path / "whole")
    with monkeypatch.context() as patch:
        kill_after(steps, patch)
        with pytest.raises(Killed):
            run(STOPPING, inputs, tmp_path / "out")
    run(STOPPING, inputs, tmp_path / "out")
    assert same_bytes(tmp_path / "whole", tmp_path / "out")


@pytest.mark.usefixtures("flat")
def test_pruning_takes_every_step_where_training_did(inputs, tmp_path):
    with_all = run(replace(STOPPING, early_stop=False), inputs, tmp_path / "train")
    assert (with_all.stopped_early_at, with_all.iterations) == (None, 160)
    (tmp_path / "prune").mkdir()
    both = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    assert prune.run(
        PruneConfig(at="mid"), both, tmp_path / "prune", CONTEXT).iterations == 160


def test_whoever_wants_the_compact_model_alone_gets_the_same_one(inputs, tmp_path, caplog):
    asked = replace(STOPPING, early_stop=False)
    for name, config in (("both", asked), ("alone", replace(asked, compact_only=True))):
        summary = run(config, inputs, tmp_path / name)
        assert summary.iterations == (96 if config.compact_only else 160)
        given = StageInputs({**inputs.folders, "train": tmp_path / name})
        (tmp_path / f"{name}-prune").mkdir()
        pruned = prune.run(PruneConfig(at="mid"), given, tmp_path / f"{name}-prune", CONTEXT)
        assert pruned.iterations == 160
    assert (tmp_path / "both-prune" / "splats.ply").read_bytes() == (
        tmp_path / "alone-prune" / "splats.ply").read_bytes()
    assert_facts(caplog.text, 96, 160, "unfinished")
    given = StageInputs({**given.folders, "prune": tmp_path / "alone-prune"})
    (tmp_path / "scores").mkdir()
    scores = evaluate.run(EvaluateConfig(trust=False), given, tmp_path / "scores", CONTEXT)
    assert scores.base_psnr_db is None
    assert scores.pruned_psnr_db > 0
    assert set(Metrics.read(tmp_path / "scores").models) == {"pruned"}
