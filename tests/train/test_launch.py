"""Several processes by torchrun: the command line in the first, the others training along."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from posed_sets import make_replica

from recon_cli import cli
from recon_cli.cli import main
from recon_cli.commands.options import Call
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import SINGLE_PROCESS, ProcessGroup, StageContext
from recon_cli.errors import BackendError
from recon_cli.io.ply import read_ply
from recon_cli.pipeline import execute
from recon_cli.progress import NullProgress
from recon_cli.render import registry
from recon_cli.train.distributed import launch

BIN = Path(sys.executable).parent
ROOT = Path(cli.__file__).parents[1]
OPTIONS = ["--iterations", "400", "--max-gaussians", "300", "--validation", "0.2", "--far", "off",
           "--sh-degree", "0", "--no-early-stop", "--threads", "1", "--checkpoint-every", "100000",
           "--device", "cpu"]
PATIENCE = 120  # seconds
torchrun_is_here = pytest.mark.skipif(
    not (BIN / "torchrun").exists(), reason="torchrun is not beside python")


def torchrun(*words, **how):
    """Starts two processes; the words that follow are torchrun's and the program's."""
    command = [BIN / "torchrun", "--standalone", "--nproc-per-node", "2", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT),
                   "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.Popen(
        [str(word) for word in command], env=environment, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, **how)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A workspace with everything that training reads."""
    base = tmp_path_factory.mktemp("launch")
    make_replica(base / "room", frames=8, tests=2)
    assert main(["ingest", str(base / "room"), "-w", str(base / "w")]) == 0
    assert main(["sfm", "-w", str(base / "w")]) == 0
    return base / "w"


@pytest.fixture(scope="module")
def trained(mapped):
    """The same trained and pruned by two processes, and what they said."""
    workspace = shutil.copytree(mapped, mapped.parent / "two")
    process = torchrun("-m", "recon_cli", "train", "--prune", "-w", workspace, *OPTIONS)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, err
    return workspace, out


def states(workspace, capsys):
    capsys.readouterr()
    assert main(["status", "--json", "-w", str(workspace)]) == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    return {row["name"]: row for row in stages}


@pytest.mark.integration
@torchrun_is_here
def test_two_processes_train_and_prune_what_one_then_finds_fresh_and_scores(trained, capsys):
    workspace, said = trained
    assert said.count("train: ") == said.count("prune: ") == 1
    found = states(workspace, capsys)
    assert {found[name]["state"] for name in ("train", "prune")} == {"fresh"}
    assert found["train"]["summary"]["processes"] == 2
    assert found["prune"]["summary"]["gaussians"] == found["train"]["summary"]["gaussians"] // 2
    assert main(["eval", "-w", str(workspace)]) == 0
    table = json.loads((workspace / "evaluate" / "metrics.json").read_text())["models"]
    assert min(table[model]["psnr_db"] for model in ("base", "pruned")) > 15
    capsys.readouterr()
    assert main(["train", "-w", str(workspace), *OPTIONS, "--batch-views", "2"]) == 0
    assert "train is up to date" in capsys.readouterr().out


@pytest.mark.integration
@torchrun_is_here
def test_ctrl_c_saves_the_state_and_one_process_goes_on(mapped, trained, tmp_path, capsys):
    workspace = shutil.copytree(mapped, tmp_path / "w")
    process = torchrun("--no-python", "recon", "train", "-w", workspace, *OPTIONS,
                       start_new_session=True)
    log = workspace / ".partial" / "train" / "log.jsonl"
    while process.poll() is None and not (log.exists() and '"loss"' in log.read_text()):
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=PATIENCE)
    assert "interrupted; run the same command again to resume" in err
    left = states(workspace, capsys)["train"]
    assert 100 <= left["done"] < 400
    assert main(["train", "-w", str(workspace), *OPTIONS, "--batch-views", "2"]) == 0
    assert f"resuming ({left['done']}/400)" in capsys.readouterr().err
    mine, theirs = (read_ply(w / "train" / "splats.ply") for w in (workspace, trained[0]))
    assert len(mine) == len(theirs)
    assert (mine.means - theirs.means).norm() <= 1e-2 * theirs.means.norm()


@pytest.mark.integration
@torchrun_is_here
def test_verbs_that_do_not_train_run_once_and_the_others_end_well(tmp_path):
    process = torchrun("-m", "recon_cli", "status", "-w", tmp_path / "none")
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, err
    assert out.count("ingest") == err.count("there is no workspace") == 1


@pytest.mark.parametrize(("typed", "count", "views"), [
    (["--batch-views", "2"], 3, 6), ([], 3, 3), ([], 1, 1), (["--batch-views", "2"], 1, 2)])
def test_the_views_of_a_step_are_those_of_all_processes(tmp_path, capsys, typed, count, views):
    words = ["train", "-w", str(tmp_path), "--print-config", *typed]
    cli.cli.main(words, standalone_mode=False, obj=Call(ranks=ProcessGroup(0, count)))
    assert f"\nbatch_views = {views}\n" in capsys.readouterr().out


def test_a_file_says_how_many_views_a_step_has_whoever_computes(tmp_path, capsys):
    (tmp_path / "recon.toml").write_text("[train]\nbatch_views = 4\n")
    words = ["train", "-w", str(tmp_path), "--print-config"]
    cli.cli.main(words, standalone_mode=False, obj=Call(ranks=ProcessGroup(0, 3)))
    assert "\nbatch_views = 4\n" in capsys.readouterr().out


def test_who_was_not_started_by_torchrun_is_alone(monkeypatch):
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    monkeypatch.setenv("RANK", "1")  # as other programs set them, too
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert not launch.follows()
    with launch.leading() as ranks:
        assert ranks is SINGLE_PROCESS


def test_one_process_by_torchrun_is_alone_too(monkeypatch):
    for name, value in (("TORCHELASTIC_RUN_ID", "x"), ("RANK", "0"), ("WORLD_SIZE", "1")):
        monkeypatch.setenv(name, value)
    assert not launch.follows()
    with launch.leading() as ranks:
        assert ranks is SINGLE_PROCESS


def test_processes_share_the_cores_of_their_machine(monkeypatch):
    monkeypatch.setattr(execute.machine, "usable_threads", lambda: 7)
    monkeypatch.setattr(registry, "use_threads", lambda *_: None)
    for local, typed, threads in ((2, None, 3), (9, None, 1), (2, 5, 5), (1, None, 7)):
        ctx = execute.render_context(
            ComputeConfig("cpu", "torch", typed), NullProgress(), ProcessGroup(0, 9, local))
        assert ctx.threads == threads


@pytest.mark.parametrize(("count", "notices"), [(4, 1), (3, 0), (1, 0)])
def test_processes_that_no_view_is_left_for_are_told_of(count, notices, caplog):
    with caplog.at_level("WARNING", logger="recon"):
        StageContext(ranks=ProcessGroup(0, count)).notice_idle(3)
    assert [record.getMessage() for record in caplog.records] == notices * [
        "1 of the 4 processes have nothing to do: a step takes --batch-views 3"]


def test_a_process_without_a_gpu_is_named_before_anything_is_done(monkeypatch):
    monkeypatch.setattr(registry, "resolve", lambda *_: ("triton", "cuda"))
    group = ProcessGroup(0, 3, 3, lacks_gpu=True)
    with pytest.raises(BackendError, match="3 processes were started") as raised:
        execute.render_context(ComputeConfig(), NullProgress(), group)
    assert "--nproc-per-node gpu" in raised.value.hint
