import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from facts import assert_facts, raises
from posed_sets import make_replica
from small_room import dots

from recon_cli.cli import main
from recon_cli.config.stages import ComputeConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs, TrainCallback
from recon_cli.errors import ConfigError, FormatError
from recon_cli.pipeline.execute import render_context
from recon_cli.progress import NullProgress
from recon_cli.scene.cells import Cell
from recon_cli.splats.ply import read_ply
from recon_cli.stages import train as stage
from recon_cli.train.blocks import blocks, merge_blocks
from recon_cli.train.blocks.blocks import BlockJob, count_blocks
from recon_cli.train.fit import runner
from recon_cli.train.fit.runner import CHECKPOINT
from recon_cli.train.fit.state import save_state

FAST = ("--iterations", "10", "--max-size", "32", "--sh-degree", "0", "--threads", "1")


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill right after the state was saved."""


class InProcess:
    """Stands for an executor: trains blocks in this process, but for those that fail."""

    slots = 1

    def __init__(self):
        self.ran, self.failing, self.commands = [], set(), []

    def run(self, command):
        name = command.workspace.name
        self.ran.append(name)
        self.commands.append(command)
        if name in self.failing:
            command.log.write_text("error: No Gaussian is left.\nhint: -\n")
            return 5
        context = render_context(ComputeConfig(threads=1), NullProgress())
        blocks.train_block(Path(command.words[1]), context)
        return 0

    def stop(self):
        raise AssertionError("the others continue")

    def close(self):
        pass


@pytest.fixture
def executor(monkeypatch):
    stand_in = InProcess()
    monkeypatch.setattr(blocks, "start_executor", lambda *_, **__: (stand_in, 1))
    return stand_in


def recon(workspace, *words):
    return main([str(word) for word in (*words, "-w", workspace)])


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A walk of 44 frames with cameras, to be copied."""
    folder = tmp_path_factory.mktemp("walk")
    source = make_replica(folder / "walk", frames=44, tests=2)
    assert recon(folder / "w", "ingest", source) == 0
    assert recon(folder / "w", "sfm") == 0
    return folder / "w"


@pytest.fixture
def workspace(mapped, tmp_path):
    return shutil.copytree(mapped, tmp_path / "w")


def state(workspace, capsys, name="train"):
    capsys.readouterr()
    assert recon(workspace, "status", "--json") == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    return next(item for item in stages if item["name"] == name)


def keep_blocks(workspace, monkeypatch):
    """Has the folders of the blocks moved beside the workspace where they would be deleted."""
    kept = workspace.with_name("kept")
    monkeypatch.setattr(blocks, "remove_blocks", lambda out: (out / "jobs").rename(kept))
    return kept


def job_of(folder, index):
    return BlockJob.read(folder / str(index) / blocks.JOB)


def own(folder):
    """Returns the Gaussians of each kept block in its own cell."""
    jobs = [job_of(folder, index) for index in range(2)]
    models = [read_ply(job.model / "splats.ply") for job in jobs]
    return [model.means.numpy()[job.cell.owns(model.means.numpy())]
            for job, model in zip(jobs, models, strict=True)]


@pytest.mark.integration
def test_recon_run_trains_in_blocks_and_goes_through_all_stages(workspace, capsys):
    words = [word for text in ("blocks=2", "iterations=10", "max_size=32", "sh_degree=0")
             for word in ("--set", f"train.{text}")]
    # made pictures are fitted to 54 dB, of which the rounding of a page would lose too much
    assert recon(workspace, "run", "--format", "ply", "--threads", 1, *words) == 0
    assert_facts(capsys.readouterr().err, "common", "middle", "finished")
    found = state(workspace, capsys)
    assert found["state"] == "fresh"
    assert found["summary"]["blocks"] == 2
    assert found["summary"]["iterations"] == 25
    assert found["summary"]["merge"]["iterations"] == 5  # a quarter of twice 10
    assert len(read_ply(workspace / "train" / "splats.ply")) == found["summary"]["gaussians"] > 0
    assert not list((workspace / ".partial").iterdir())
    assert {path.name for path in (workspace / "train").iterdir()} == {
        "manifest.json", "splats.ply", "config.json", "log.jsonl"}
    for name in ("prune", "evaluate", "export"):
        assert state(workspace, capsys, name)["state"] == "fresh"
    assert state(workspace, capsys, "prune")["summary"]["at"] == "end"
    scores = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    assert scores["models"]["pruned"]["gaussians"] < scores["models"]["base"]["gaussians"]
    assert "whoever trained it" not in (workspace / "evaluate" / "table.txt").read_text()


@pytest.mark.integration
def test_a_block_that_fails_stops_no_other_and_is_all_that_is_tried_again(
    workspace, tmp_path, executor, capsys
):
    executor.failing = {"0"}
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 5
    error = capsys.readouterr().err
    assert_facts(error, 1, 2, 0, "blocks", "Gaussian")
    assert str(workspace / ".partial" / "train" / "jobs" / "0" / blocks.OUTPUT) in error
    assert state(workspace, capsys)["state"] == "partial"
    executor.failing = set()
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert executor.ran == ["0", "1", "0"]
    again = shutil.copytree(workspace, tmp_path / "again")
    assert recon(again, "train", "--blocks", 2, "--again", *FAST) == 0
    assert executor.ran == ["0", "1", "0", "0", "1"]
    same, = {(folder / "train" / "splats.ply").read_bytes() for folder in (workspace, again)}
    assert same
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert_facts(capsys.readouterr().out, "train", "date")
    assert len(executor.ran) == 5


@pytest.mark.integration
def test_a_finished_block_that_was_damaged_meanwhile_is_trained_again(workspace, executor):
    executor.failing = {"1"}
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 5
    model = workspace / ".partial" / "train" / "jobs" / "0" / "train" / "splats.ply"
    data = bytearray(model.read_bytes())
    data[-1] ^= 1
    model.write_bytes(data)
    executor.failing = set()
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert executor.ran == ["0", "1", "0", "1"]


@pytest.mark.integration
def test_other_options_begin_the_blocks_anew(workspace, executor, capsys):
    executor.failing = {"1"}
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 5
    assert recon(workspace, "train", "--blocks", 2, "--seed", 1, *FAST) == 5
    assert executor.ran == ["0", "1", "0", "1"]
    assert recon(workspace, "train", "--blocks", "off", *FAST) == 0
    assert len(executor.ran) == 4
    assert "blocks" not in state(workspace, capsys)["summary"]
    executor.failing = set()
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert state(workspace, capsys)["summary"]["blocks"] == 2


@pytest.mark.integration
def test_more_steps_than_those_of_a_training_in_blocks_begin_anew(workspace, executor, capsys):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert recon(workspace, "train", "--blocks", 2, *FAST[2:], "--iterations", 30, "-v") == 0
    assert_facts(capsys.readouterr().err, "finished", "trained", "blocks")
    assert executor.ran == ["0", "1", "0", "1"]


@pytest.mark.integration
def test_a_merge_killed_while_it_fine_tunes_ends_with_the_same_bytes(
    workspace, executor, monkeypatch
):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    model = workspace / "train" / "splats.ply"
    whole = model.read_bytes()

    def save_then_die(path, state):
        save_state(path, state)
        if path.parts[-2:] == ("train", CHECKPOINT) and "jobs" not in path.parts:
            raise Killed

    words = ("train", "--blocks", 2, *FAST, "--checkpoint-every", 2)
    with monkeypatch.context() as patch:
        patch.setattr(runner, "save_state", save_then_die)
        patch.setattr(runner.CheckpointThrottle, "allows", lambda _: True)
        assert recon(workspace, *words, "--again") == 1
    partial = workspace / ".partial" / "train"
    assert (partial / CHECKPOINT).exists()
    assert len(executor.ran) == 4
    shutil.rmtree(workspace / "train")
    assert recon(workspace, *words) == 0
    assert len(executor.ran) == 4
    assert model.read_bytes() == whole
    assert not (workspace / "train" / CHECKPOINT).exists()


@pytest.mark.integration
def test_a_merged_scene_too_large_to_train_is_kept_as_the_blocks_have_it(
    workspace, capsys, monkeypatch, executor
):
    kept = keep_blocks(workspace, monkeypatch)
    monkeypatch.setattr(merge_blocks, "gaussians_that_fit", lambda *_: 1)
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert executor.ran == ["0", "1"]
    assert_facts(capsys.readouterr().err, 1, "merged", "fine-tuned")
    assert state(workspace, capsys)["summary"]["merge"]["iterations"] == 0
    assert not (workspace / "train" / "log.jsonl").exists()
    merged = read_ply(workspace / "train" / "splats.ply").means.numpy()
    assert np.array_equal(merged, np.concatenate(own(kept)))


@pytest.mark.integration
def test_gaussians_are_added_in_the_cell_alone_and_validation_views_are_common(
    workspace, monkeypatch, executor
):
    kept = keep_blocks(workspace, monkeypatch)
    assert recon(workspace, "train", "--blocks", 2, *FAST[2:], "--iterations", 150) == 0
    jobs = [job_of(kept, index) for index in range(len(set(executor.ran)))]
    means = read_ply(jobs[0].model / "splats.ply").means.numpy()
    inside = jobs[0].cell.owns(means)
    assert inside.sum() > 2 * (~inside).sum()
    assert jobs[0].validation == jobs[1].validation != frozenset()
    assert len(jobs[0].views | jobs[1].views) == 46
    assert (jobs[0].cell.owned ^ jobs[1].cell.owned).all()


@pytest.mark.integration
@pytest.mark.parametrize(("asked", "said"), [
    ("3", "46 views are too few for 3 blocks"), ("many", "blocks is 'many'"),
    ("0", "blocks is '0'")])
def test_a_number_of_blocks_that_cannot_be_is_refused(workspace, capsys, asked, said):
    assert recon(workspace, "train", "--blocks", asked, *FAST) == 2
    error = capsys.readouterr().err
    assert said in error
    assert f"--blocks {'2' if asked == '3' else 'auto'}" in error
    assert not (workspace / "train").exists()


def test_a_word_in_place_of_a_number_is_refused_before_anything_is_read(tmp_path, capsys):
    assert recon(tmp_path / "none", "train", "--blocks", "foo") == 2
    assert main(["run", "--set", "train.blocks=foo", "-w", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.count("blocks is 'foo'") == 2
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(("views", "asked", "count"), [
    (1200, "auto", 1), (1201, "auto", 2), (46, "2", 2), (46, "1", 1), (9000, "off", 1)])
def test_the_number_of_blocks_follows_the_views(views, asked, count):
    assert count_blocks(views, asked) == count


@pytest.mark.parametrize("views", [10, 46, 100])
def test_the_hint_names_a_number_that_is_taken(views):
    with pytest.raises(ConfigError) as raised:
        count_blocks(views, "999")
    most = raised.value.hint.split("--blocks ")[1].split()[0]
    assert count_blocks(views, most) == int(most)


class Scene:
    train, validation, test = ("view",) * 40, (), ("view",) * 6


@pytest.mark.parametrize(("options", "said"), [
    ({"blocks": "2"}, "which the page does not show"), ({"on": "ray"}, "only blocks run on Ray")])
def test_what_an_option_does_not_do_is_told(caplog, options, said):
    ctx = StageContext(callbacks=(TrainCallback(),))
    stage._count_blocks(TrainConfig(**options), Scene(), None, ctx)
    assert said in caplog.text


def test_a_finished_scene_is_not_trained_further_in_blocks():
    with raises(ConfigError, "trained", "further"):
        stage._count_blocks(TrainConfig(blocks="2"), Scene(), object(), StageContext())
    assert stage._count_blocks(TrainConfig(), Scene(), object(), StageContext()) == 1


def test_a_job_comes_back_from_its_file_and_its_place_takes_no_part_in_its_key(tmp_path):
    cell = Cell(np.random.default_rng(0).random((5, 3)), np.array([1, 0, 0, 1, 1], bool))
    inputs = StageInputs({"place": tmp_path / "place"}, digests={"place": "abc"})
    job = BlockJob(tmp_path / "0", inputs, frozenset("ab"), frozenset("b"), cell,
                   TrainConfig(iterations=7))
    job.write()
    again = BlockJob.read(tmp_path / "0" / blocks.JOB)
    assert (again.views, again.validation, again.config) == (job.views, job.validation, job.config)
    assert np.array_equal(again.cell.points, cell.points)
    assert again.key == job.key
    (tmp_path / "0").rename(tmp_path / "moved")
    assert BlockJob.read(tmp_path / "moved" / blocks.JOB).key.fingerprint == job.key.fingerprint
    (tmp_path / "moved" / blocks.JOB).write_bytes(b"damaged")
    with raises(FormatError, "describe", "block"):
        BlockJob.read(tmp_path / "moved" / blocks.JOB)


def test_of_a_block_only_what_lies_in_its_own_cell_is_merged():
    """The neighbour has the rest, which it saw from nearer."""
    cell = Cell(np.array([[0.0, 0, 0], [2, 0, 0]]), np.array([True, False]))
    splats = dots([[0.2, 0, 0], [1.8, 0, 0], [-3, 0, 0]])
    block = merge_blocks.TrainedBlock("0", splats, cell, frozenset(), None, None)
    assert merge_blocks._own(block).means[:, 0].tolist() == pytest.approx([0.2, -3])
