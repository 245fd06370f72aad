import json
import shutil

import pytest
import torch
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.errors import ReconstructionError
from recon_cli.io.colmap import read_pinholes
from recon_cli.io.ply import read_ply
from recon_cli.io.records import BlockRecord
from recon_cli.pipeline.blocks import Block, train_blocks
from recon_cli.progress import NullProgress
from recon_cli.stages import merge
from recon_cli.train import runner
from recon_cli.train.runner import CHECKPOINT
from recon_cli.train.state import save_state

FAST = ("--iterations", "10", "--max-size", "32", "--sh-degree", "0", "--threads", "1")


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill right after the state was saved."""


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


def block(workspace, number):
    return workspace / "blocks" / str(number)


def owned(workspace, number):
    """Returns the Gaussians of a block in its own cell."""
    splats = read_ply(block(workspace, number) / "train" / "splats.ply")
    record = BlockRecord.read(block(workspace, number) / "sfm")
    return splats.select(torch.from_numpy(record.cell.owns(splats.means.numpy())))


def state(workspace, capsys, stage="train"):
    capsys.readouterr()
    assert recon(workspace, "status", "--json") == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    return next(item for item in stages if item["name"] == stage)


@pytest.mark.integration
def test_a_scene_trained_in_blocks_goes_through_the_stages_like_any_other(workspace, capsys):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert state(workspace, capsys)["summary"]["iterations"] == 5  # a quarter of twice 10
    assert len(read_ply(workspace / "train" / "splats.ply")) > 0
    for number in range(2):
        record = BlockRecord.read(block(workspace, number) / "sfm")
        log = (block(workspace, number) / "train" / "log.jsonl").read_text()
        assert record.validation  # the same views steer all blocks and none is trained on them
        assert '"iteration": 10' in log
    assert recon(workspace, "prune", "--ratio", 0.5) == 0
    assert recon(workspace, "eval") == 0
    assert recon(workspace, "export") == 0
    for stage in ("prune", "evaluate", "export"):
        assert state(workspace, capsys, stage)["state"] == "fresh"
    scores = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    assert scores["models"]["pruned"]["gaussians"] < scores["models"]["base"]["gaussians"]
    assert "whoever trained it" not in (workspace / "evaluate" / "table.txt").read_text()


@pytest.mark.integration
def test_without_fine_tuning_each_block_keeps_its_cell_as_it_was_trained(workspace):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert recon(workspace, "merge", "--iterations", 0) == 0
    parts = [owned(workspace, number) for number in range(2)]
    merged = read_ply(workspace / "train" / "splats.ply")
    assert len(merged) == sum(map(len, parts)) > 0
    assert torch.equal(merged.means, torch.cat([part.means for part in parts]))
    assert not (workspace / "train" / "log.jsonl").exists()


@pytest.mark.slow
def test_fine_tuning_brings_the_blocks_closer_to_the_views(workspace):
    assert recon(workspace, "train", "--blocks", 2, *FAST[2:], "--iterations", 60) == 0
    scores = {}
    for steps in (0, 100):
        assert recon(workspace, "merge", "--iterations", steps, "--again") == 0
        assert recon(workspace, "eval") == 0
        scores[steps] = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    assert (scores[100]["models"]["base"]["psnr_db"] > scores[0]["models"]["base"]["psnr_db"] + 0.3)


@pytest.mark.slow
def test_a_merge_killed_while_it_fine_tunes_ends_with_the_same_bytes(workspace, monkeypatch):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    model = workspace / "train" / "splats.ply"
    steps = ("--iterations", 300)
    assert recon(workspace, "merge", *steps) == 0
    whole = model.read_bytes()
    assert recon(workspace, "merge", "--iterations", 0) == 0

    def save_then_die(path, state):
        save_state(path, state)
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(runner, "save_state", save_then_die)
        patch.setattr(runner.CheckpointThrottle, "allows", lambda _: True)
        assert recon(workspace, "merge", *steps) == 1
    assert (workspace / ".partial" / "train" / CHECKPOINT).exists()
    assert recon(workspace, "merge", *steps) == 0
    assert model.read_bytes() == whole
    assert not (workspace / "train" / CHECKPOINT).exists()


@pytest.mark.integration
def test_a_merged_scene_too_large_to_train_is_kept_as_the_blocks_have_it(
    workspace, capsys, monkeypatch
):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    monkeypatch.setattr(merge, "gaussians_that_fit", lambda *_: 1)
    assert recon(workspace, "merge", "--iterations", 6) == 0
    assert "memory has room to train 1: it is not fine-tuned" in capsys.readouterr().err
    assert state(workspace, capsys)["summary"]["iterations"] == 0


@pytest.mark.integration
def test_the_same_command_again_trains_nothing(workspace, capsys):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    before = [(path, path.stat().st_mtime_ns) for path in sorted(workspace.rglob("splats.ply"))]
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert "train is up to date" in capsys.readouterr().out
    assert before == [(path, path.stat().st_mtime_ns) for path, _ in before]


@pytest.mark.integration
def test_a_block_trained_again_by_hand_makes_the_scene_stale(workspace, capsys):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    assert recon(block(workspace, 1), "train", *FAST[2:], "--iterations", 5, "--again") == 0
    assert state(workspace, capsys)["state"] == "stale"
    assert recon(workspace, "merge") == 0
    assert state(workspace, capsys)["state"] == "fresh"


@pytest.mark.integration
def test_a_model_changed_by_hand_is_not_merged(workspace, capsys):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    path = block(workspace, 1) / "train" / "splats.ply"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert recon(workspace, "merge") == 4
    error = capsys.readouterr().err
    assert "Block 1 of 2 has no finished training" in error
    assert "splats.ply was changed by hand" in error


@pytest.mark.integration
def test_a_missing_block_is_named(workspace, capsys):
    assert recon(workspace, "merge") == 4
    assert "has no blocks to merge" in capsys.readouterr().err
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    shutil.rmtree(block(workspace, 0) / "train")
    assert recon(workspace, "merge") == 4
    assert "Block 0 of 2 has no finished training: it is missing" in capsys.readouterr().err


@pytest.mark.integration
def test_other_views_or_another_number_cut_the_scene_again(workspace):
    assert recon(workspace, "train", "--blocks", 2, *FAST) == 0
    views = [read_pinholes(block(workspace, number) / "sfm" / "undistorted" / "sparse").keys()
             for number in range(2)]
    assert len(views[0] | views[1]) == 46
    assert recon(workspace, "train", "--blocks", 1, *FAST) == 4  # it would replace the merged scene
    assert recon(workspace, "train", "--blocks", "off", "--again", *FAST) == 0
    assert (workspace / "train" / "log.jsonl").exists()


@pytest.mark.parametrize(("asked", "said"), [
    ("3", "46 views are too few for 3 blocks"), ("many", "blocks is 'many'"),
    ("0", "blocks is '0'")])
def test_a_number_of_blocks_that_cannot_be_is_refused(workspace, capsys, asked, said):
    assert recon(workspace, "train", "--blocks", asked, *FAST) == 2
    assert said in capsys.readouterr().err
    assert not (workspace / "blocks").exists()


def test_a_small_capture_is_not_cut(workspace):
    assert recon(workspace, "train", *FAST) == 0
    assert not (workspace / "blocks").exists()


class Failing:
    """Stands for an executor on which one block fails."""

    slots = 1

    def __init__(self):
        self.ran = []

    def run(self, command):
        self.ran.append(command.workspace.name)
        command.log.parent.mkdir(parents=True, exist_ok=True)
        command.log.write_text("error: No Gaussian is left.\nhint: -\n")
        return 5 if command.workspace.name == "1" else 0

    def stop(self):
        raise AssertionError("the others go on")


def test_a_block_that_fails_stops_no_other(tmp_path):
    blocks = [Block(str(number), tmp_path / str(number)) for number in range(3)]
    executor, said = Failing(), []
    with pytest.raises(ReconstructionError, match="1 of 3 blocks failed: 1: No Gaussian is left"):
        train_blocks(blocks, [], executor, NullProgress(), said.append)
    assert executor.ran == ["0", "1", "2"]
    assert said == ["block 0: trained", "block 1: No Gaussian is left.", "block 2: trained"]


@pytest.mark.integration
def test_gaussians_are_added_in_the_cell_alone(workspace):
    assert recon(workspace, "train", "--blocks", 2, *FAST[2:], "--iterations", 150) == 0
    record = BlockRecord.read(block(workspace, 0) / "sfm")
    splats = read_ply(block(workspace, 0) / "train" / "splats.ply")
    inside = record.cell.owns(splats.means.numpy())
    assert inside.sum() > 2 * (~inside).sum()
