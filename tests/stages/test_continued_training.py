"""Training that continues a finished run: gains, files kept, records and repeats."""

from __future__ import annotations

from dataclasses import replace

import pytest
from facts import assert_facts, raises
from killed import Killed, kill_after
from tiny_scene import make_inputs

from recon_cli.config.stages import PruneConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import FormatError
from recon_cli.splats.ply import read_ply
from recon_cli.stages import prune, train
from recon_cli.train import plan as planning
from recon_cli.train.fit import loop
from recon_cli.workspace.summaries import LogRow, TrainPlan

pytestmark = pytest.mark.integration

CONTEXT = StageContext(backend="numba")
SHORT = TrainConfig(
    iterations=160, max_gaussians=120, densify_every=10, checkpoint_every=7, sh_degree=1)
LONG = replace(SHORT, iterations=320)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    return make_inputs(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def finished(inputs, tmp_path_factory):
    """The folder of a finished run of 160 steps."""
    out = tmp_path_factory.mktemp("finished")
    train.run(SHORT, inputs, out, CONTEXT)
    return out


@pytest.fixture(scope="module")
def continued(inputs, finished, tmp_path_factory):
    """The folder of a run that was continued to 320 steps, and its summary."""
    out = tmp_path_factory.mktemp("continued")
    return out, go_on(LONG, inputs, finished, out)


def go_on(config, inputs, finished, out, ctx=CONTEXT):
    out.mkdir(exist_ok=True)
    return train.run(config, StageInputs(inputs.folders, continues=finished), out, ctx)


def same_bytes(one, other):
    return all((one / name).read_bytes() == (other / name).read_bytes()
               for name in ("splats.ply", "mid.safetensors", "final.safetensors", "config.json"))


def test_the_result_says_where_it_went_on_and_is_better(finished, continued):
    out, summary = continued
    assert (summary.continued_from_step, summary.iterations) == (160, 320)
    assert summary.imported_from is None
    assert TrainPlan.read(out).continues_at == 160
    before = LogRow.read_all(finished / "log.jsonl")
    assert summary.validation_psnr_db > before[-1].validation_psnr_db + 0.3
    assert summary.initial_gaussians == len(read_ply(finished / "splats.ply"))


def test_the_log_tells_of_the_whole_training(finished, continued):
    out, summary = continued
    before, rows = (LogRow.read_all(path / "log.jsonl") for path in (finished, out))
    assert rows[:len(before)] == before
    assert [row.iteration for row in rows[len(before):]] == [200, 300, 320]
    assert summary.train_seconds == rows[-1].seconds > before[-1].seconds


@pytest.mark.parametrize("steps", [161, 200, 260])
def test_a_killed_run_ends_with_the_bytes_of_an_uninterrupted_one(
    inputs, finished, continued, tmp_path, monkeypatch, steps
):
    with monkeypatch.context() as patch:
        kill_after(steps, patch)
        with pytest.raises(Killed):
            go_on(LONG, inputs, finished, tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(planning, "calibrate", None)  # would fail if it were called
        go_on(LONG, inputs, finished, tmp_path / "out")
    assert same_bytes(continued[0], tmp_path / "out")


def test_the_count_grows_to_a_higher_cap(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(planning, "useful_cap", lambda _, iterations: iterations // 2)
    shorter = replace(SHORT, max_gaussians=None)
    (tmp_path / "short").mkdir()
    first = train.run(shorter, inputs, tmp_path / "short", CONTEXT)
    second = go_on(replace(shorter, iterations=320), inputs, tmp_path / "short", tmp_path / "long")
    assert (first.max_gaussians, second.max_gaussians) == (80, 160)
    assert first.gaussians <= 80 < second.gaussians <= 160


def test_it_keeps_the_parts_of_the_model_without_a_trial(inputs, tmp_path, monkeypatch):
    (tmp_path / "short").mkdir()
    asked = replace(SHORT, sh_degree=None)
    train.run(replace(asked, exposure="on"), inputs, tmp_path / "short", CONTEXT)
    monkeypatch.setattr(planning, "choose_parts", None)  # would fail if it were called
    summary = go_on(replace(asked, iterations=200), inputs, tmp_path / "short", tmp_path / "long")
    assert summary.parts["exposure"] == "on"
    assert TrainPlan.read(tmp_path / "long").needs == TrainPlan.read(tmp_path / "short").needs


@pytest.mark.parametrize("at", ["mid", "end"])
def test_it_can_be_pruned_at_its_middle_and_its_end(inputs, continued, tmp_path, at):
    out, summary = continued
    both = StageInputs({**inputs.folders, "train": out})
    pruned = prune.run(PruneConfig(at=at, rounds=2), both, tmp_path, CONTEXT)
    assert pruned.gaussians == -(-summary.gaussians // 2)
    # where the rest of the run is longer than a sixth and six epochs, both have seen as many steps
    assert pruned.recovery_steps == (64 if at == "mid" else 53)


def test_after_few_more_steps_pruning_at_the_middle_recovers_as_at_the_end(
    inputs, finished, tmp_path
):
    go_on(replace(SHORT, iterations=190), inputs, finished, tmp_path / "train")
    both = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    (tmp_path / "prune").mkdir()
    pruned = prune.run(PruneConfig(at="mid"), both, tmp_path / "prune", CONTEXT)
    assert (pruned.recovery_steps, pruned.iterations) == (48, 178 + 48)


def test_after_an_early_stop_it_goes_on_from_the_steps_taken(inputs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(loop, "report_every", lambda _: 4)
        patch.setattr(loop, "validation_psnr", lambda *_: 20.0)
        (tmp_path / "short").mkdir()
        first = train.run(SHORT, inputs, tmp_path / "short", CONTEXT)
        second = go_on(LONG, inputs, tmp_path / "short", tmp_path / "long")
    assert (first.stopped_early_at, first.iterations) == (100, 132)
    assert second.continued_from_step == 132
    # two tenths of its own 188 steps are skipped again
    assert 132 + 0.6 * 188 < second.stopped_early_at < 132 + 0.8 * 188
    rows = LogRow.read_all(tmp_path / "long" / "log.jsonl")
    assert [row.iteration for row in rows] == sorted({row.iteration for row in rows})
    assert [row.iteration for row in rows if row.skip_to_iteration] == [second.stopped_early_at]


def test_few_more_steps_are_said_to_gain_nothing(inputs, finished, tmp_path, caplog):
    go_on(replace(SHORT, iterations=165), inputs, finished, tmp_path / "out")
    assert_facts(caplog.text, 5, 160, "steps")


def test_a_damaged_end_of_the_finished_run_is_refused_with_what_to_type(
    inputs, finished, tmp_path
):
    broken = tmp_path / "broken"
    broken.mkdir()
    for path in finished.iterdir():
        (broken / path.name).write_bytes(path.read_bytes())
    (broken / "final.safetensors").write_bytes(b"\0" * 64)
    with raises(FormatError, broken / "final.safetensors") as caught:
        go_on(LONG, inputs, broken, tmp_path / "out")
    assert "--again" in caught.value.hint
