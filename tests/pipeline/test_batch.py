import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from facts import assert_facts, raises
from posed_sets import make_replica

from recon_cli.cli import main
from recon_cli.errors import BackendError, ConfigError
from recon_cli.pipeline.batch import name_captures, run_batch
from recon_cli.progress import NullProgress
from recon_cli.workspace.layout import Workspace, hold_lock

FAST = ("train.iterations=10", "train.max_size=32", "train.checkpoint_every=5")


class Fake:
    """Stands for an executor: writes a log and returns a code, by the capture's name."""

    def __init__(self, outcomes, slots=1):
        self.outcomes, self.slots, self.commands, self.stopped = outcomes, slots, [], False

    def run(self, command):
        self.commands.append(command)
        outcome = self.outcomes[command.workspace.name]
        if isinstance(outcome, BaseException):
            raise outcome
        code, text = outcome
        command.log.parent.mkdir(parents=True, exist_ok=True)
        command.log.write_text(text, encoding="utf-8")
        return code

    def stop(self):
        self.stopped = True

    def close(self):
        pass


def run(tmp_path, executor, names, report=lambda _: None):
    captures = name_captures([tmp_path / "in" / f"{name}.mp4" for name in names], tmp_path / "out")
    (tmp_path / "out").mkdir(exist_ok=True)
    return run_batch(captures, tmp_path / "out", ["--again"], executor, NullProgress(), report)


def recon(*words):
    return main([str(word) for word in words])


def read(tmp_path):
    return json.loads((tmp_path / "out" / "batch.json").read_text())["captures"]


def test_captures_are_named_after_their_files():
    names = [capture.name for capture in name_captures(
        [Path("/a/room.mp4"), Path("/b/hall.v2.mov"), Path("/c/photos.raw")], Path("/out"))]
    assert names == ["room", "hall.v2", "photos"]


def test_captures_of_one_name_have_their_folders_before_it():
    names = [capture.workspace for capture in name_captures(
        [Path("/a/room.mp4"), Path("/b/room.mov"), Path("/b/hall.mov")], Path("/out"))]
    assert names == [Path("/out/a-room"), Path("/out/b-room"), Path("/out/hall")]


@pytest.mark.parametrize("inputs", [
    ("/a/room.mp4", "/a/room.mp4"), ("/a/room.mp4", "/a/room.mov")])
def test_two_captures_in_one_workspace_are_refused(inputs):
    with raises(ConfigError, *inputs):
        name_captures([Path(path) for path in inputs], Path("/out"))


def test_a_failure_stops_no_other_capture_and_its_reason_is_that_of_its_command(tmp_path):
    results = run(tmp_path, Fake({
        "a": (0, ""), "b": (3, "notice: x\nerror: It is dark.\nhint: Light.\n"), "c": (0, "")}),
        ["a", "b", "c"])
    assert [(result.capture, result.exit_code, result.reason) for result in results] == [
        ("a", 0, ""), ("b", 3, "It is dark."), ("c", 0, "")]
    assert read(tmp_path) == [result.to_json() for result in results]


@pytest.mark.parametrize(("code", "text", "reason"), [
    (1, "Traceback\nValueError: no", "ValueError: no"),
    (1, "", "no message"),
    (137, "train 5%", "killed by signal 9"),
    (130, "error: nothing", "interrupted"),
    (5, "error: first\nhint: a\nerror: last\nhint: b", "last"),
])
def test_a_reason_is_found_whatever_a_command_left(tmp_path, code, text, reason):
    result, = run(tmp_path, Fake({"a": (code, text)}), ["a"])
    assert reason in result.reason


def test_the_options_and_the_input_reach_the_command(tmp_path):
    fake = Fake({"a": (0, "")})
    run(tmp_path, fake, ["a"])
    command, = fake.commands
    assert command.words == (
        "run", str(tmp_path / "in" / "a.mp4"), "-w", str(tmp_path / "out" / "a"), "--again")


def test_results_so_far_are_in_the_file_while_others_run(tmp_path):
    seen = []
    run(tmp_path, Fake({"a": (0, ""), "b": (3, "error: no")}), ["a", "b"],
        lambda _: seen.append([row["exit_code"] for row in read(tmp_path)]))
    assert seen == [[0, None], [0, 3]]


def test_a_full_disk_is_the_failure_of_one_capture(tmp_path):
    results = run(tmp_path, Fake({"a": OSError(28, "No space left"), "b": (0, "")}), ["a", "b"])
    assert [result.exit_code for result in results] == [7, 0]
    assert_facts(results[0].reason, "space", "left")


def test_lost_machines_end_the_batch_and_stop_what_runs(tmp_path):
    fake = Fake({"a": (0, ""), "b": BackendError("gone"), "c": (0, "")})
    with pytest.raises(BackendError):
        run(tmp_path, fake, ["a", "b", "c"])
    assert fake.stopped
    assert [row["exit_code"] for row in read(tmp_path)] == [0, None, None]


def test_as_many_commands_as_there_are_slots_run_at_once(tmp_path):
    both = threading.Barrier(2, timeout=30)

    class Meeting(Fake):
        def run(self, command):
            both.wait()  # breaks unless two run at once
            return super().run(command)

    results = run(tmp_path, Meeting({"a": (0, ""), "b": (0, "")}, slots=2), ["a", "b"])
    assert all(result.succeeded for result in results)


@pytest.mark.integration
def test_a_batch_is_what_single_runs_are_and_goes_on_with_what_is_unfinished(tmp_path, capsys):
    make_replica(tmp_path / "kitchen", frames=6, tests=0)
    make_replica(tmp_path / "hall", frames=6, tests=0)
    (tmp_path / "torn.mp4").write_bytes(b"no video")
    words = ["batch", tmp_path / "kitchen", tmp_path / "torn.mp4", tmp_path / "hall",
             "--out", tmp_path / "out", "--jobs", "2", "--threads", "1",
             *(word for text in FAST for word in ("--set", text))]
    assert recon(*words) == 5
    assert_facts(capsys.readouterr().err, 1, 3, "captures", "failed")
    rows = {row["capture"]: row for row in read(tmp_path)}
    assert [rows[name]["exit_code"] for name in ("kitchen", "torn", "hall")] == [0, 3, 0]
    assert_facts(rows["torn"]["reason"], "torn.mp4", "video")
    assert rows["hall"]["frames"] == rows["hall"]["registered"] == 6
    page = (tmp_path / "out" / "batch.html").read_text(encoding="utf-8")
    assert_facts(page, 2, 3, "captures", "scene")
    assert "kitchen/export/splats.ply" in page

    assert recon("run", tmp_path / "kitchen", "-w", tmp_path / "alone", "--threads", "1",
                 *(word for text in FAST for word in ("--set", text))) == 0
    ply = Path("export", "splats.ply")
    expected = (tmp_path / "alone" / ply).read_bytes()
    assert (tmp_path / "out" / "kitchen" / ply).read_bytes() == expected

    shutil.rmtree(tmp_path / "out" / "kitchen" / "train")
    (tmp_path / "torn.mp4").unlink()
    before = (tmp_path / "out" / "hall" / "train" / "splats.ply").stat().st_mtime_ns
    assert recon(*[word for word in words if word != tmp_path / "torn.mp4"]) == 0
    assert (tmp_path / "out" / "kitchen" / ply).read_bytes() == expected
    assert (tmp_path / "out" / "hall" / "train" / "splats.ply").stat().st_mtime_ns == before


@pytest.mark.integration
def test_a_workspace_of_another_capture_is_left_alone(tmp_path, capsys):
    make_replica(tmp_path / "a" / "room", frames=6, tests=0)
    make_replica(tmp_path / "b" / "room", frames=6, tests=0)
    assert recon("ingest", tmp_path / "a" / "room", "-w", tmp_path / "out" / "room") == 0
    assert recon("batch", tmp_path / "b" / "room", "--out", tmp_path / "out") == 2
    assert_facts(capsys.readouterr().err, "error:", tmp_path / "out" / "room")


def test_two_batches_do_not_share_a_folder(tmp_path, capsys):
    (tmp_path / "out").mkdir()
    with hold_lock(tmp_path / "out", "batch"):
        assert recon("batch", tmp_path / "room.mp4", "--out", tmp_path / "out") == 7
    assert_facts(capsys.readouterr().err, "recon batch")
    assert not (tmp_path / "out" / "batch.json").exists()


STEPS = 1200
SLOW = (f"train.iterations={STEPS}", "train.max_size=32", "train.checkpoint_every=40")


def batch_words(inputs, out, settings, *more):
    words = ["batch", *inputs, "--out", out, "--threads", "1", "--no-prune", *more]
    words += [word for text in settings for word in ("--set", text)]
    return [str(word) for word in words]


def wait_for(found, seconds=120):
    end = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return value


def saved_steps(workspace):
    """Tells how many steps the checkpoint of an unfinished training has."""
    partial = Workspace(workspace).partial_run("train")
    return partial.done if partial else 0


def training_process(batch):
    """Returns the process that trains for a batch."""
    found = [child for child in psutil.Process(batch.pid).children(recursive=True)
             if "run" in child.cmdline()]
    return found[0] if found else None


@pytest.mark.integration
def test_a_batch_whose_processes_are_killed_ends_with_the_same_bytes(tmp_path):
    source = make_replica(tmp_path / "room", frames=6, tests=0)
    assert main(batch_words([source], tmp_path / "expected", SLOW)) == 0
    words = batch_words([source], tmp_path / "out", SLOW)
    workspace = tmp_path / "out" / "room"
    with subprocess.Popen(
            [sys.executable, "-m", "recon_cli", *words], stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT) as process:
        wait_for(lambda: saved_steps(workspace) >= 80)
        first = training_process(process)
        first.send_signal(signal.SIGKILL)
        first.wait(60)
        second = wait_for(lambda: training_process(process))
        wait_for(lambda: saved_steps(workspace) >= 240)
        process.send_signal(signal.SIGKILL)
        process.wait()
    second.wait(60)  # it ends with the batch
    assert saved_steps(workspace) < STEPS
    assert main(words) == 0
    for name in ("train/splats.ply", "export/splats.ply"):
        expected = tmp_path / "expected" / "room" / name
        assert (workspace / name).read_bytes() == expected.read_bytes(), name
