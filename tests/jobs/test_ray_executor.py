import os
import signal
import subprocess
import sys
import threading
import time
from importlib import import_module
from pathlib import Path

import psutil
import pytest
from facts import assert_facts, raises
from posed_sets import make_replica

from recon_cli import __version__
from recon_cli.errors import BackendError, WorkspaceError
from recon_cli.jobs.executor import Command
from recon_cli.machine import install_command
from recon_cli.workspace.layout import Workspace

STEPS, SAVE_EVERY = 1500, 50


@pytest.fixture
def ray_clusters():
    """Returns the module of that name beside the tests."""
    pytest.importorskip("ray")
    return import_module("ray_clusters")


@pytest.fixture
def ray_executor():
    """Returns the module; collecting tests does not import Ray, which takes a second."""
    pytest.importorskip("ray")
    return import_module("recon_cli.jobs.ray_executor")


def node(cpus, gpus=0):
    return {"Resources": {"CPU": float(cpus), "GPU": float(gpus)}, "NodeManagerAddress": "h"}


@pytest.mark.parametrize(("nodes", "cores", "gpu", "expected"), [
    ([node(2)], None, None, (2, 0)),
    ([node(2), node(16)], None, None, (4, 0)),  # more cores shorten a command by little
    ([node(2), node(16)], 8, False, (8, 0)),
    ([node(16), node(8, 1)], None, None, (4, 1)),
    ([node(16), node(8, 1)], None, False, (4, 0)),
])
def test_a_command_asks_for_what_a_machine_of_the_cluster_has(
        ray_executor, nodes, cores, gpu, expected):
    assert ray_executor._choose_resources(nodes, cores, gpu) == expected


@pytest.mark.parametrize(("nodes", "cores", "gpu", "facts"), [
    ([node(16), node(8)], None, True, [2, "GPU"]),
    ([node(2), node(4)], 8, None, [8, 4]),
    ([node(16), node(2, 1)], 8, True, [8, 2]),
])
def test_a_cluster_that_lacks_what_is_asked_for_is_refused(ray_executor, nodes, cores, gpu, facts):
    with raises(BackendError, *facts):
        ray_executor._choose_resources(nodes, cores, gpu)


def test_without_ray_the_error_says_how_to_install_it(ray_executor, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_executor, "ray", None)
    with raises(BackendError, "installed") as caught:
        ray_executor.RayExecutor.connect(
            cores=None, gpu=None, slots=None, folder=tmp_path, inputs=[])
    assert install_command("ray") in caught.value.hint


def test_what_ray_runs_does_not_wait_for_more_of_ray(ray_executor, tmp_path, monkeypatch):
    monkeypatch.setenv(ray_executor._INSIDE, "1")
    with raises(BackendError, "share", "again"):
        ray_executor.RayExecutor.connect(
            cores=None, gpu=None, slots=None, folder=tmp_path, inputs=[])


def test_a_cluster_that_does_not_answer_is_an_error(ray_executor, tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "not an address")
    with raises(BackendError, "cluster", "answers"):
        ray_executor.RayExecutor.connect(
            cores=None, gpu=None, slots=None, folder=tmp_path, inputs=[])


def test_a_machine_tells_what_it_sees(ray_executor, tmp_path):
    (tmp_path / "probe").write_text("token")
    (tmp_path / "a.mp4").touch()
    seen = ray_executor._probe(
        str(tmp_path), "probe", "token", [str(tmp_path / "a.mp4"), "/nowhere/b.mp4"])
    assert seen == {"version": __version__, "sees": True, "missing": ["/nowhere/b.mp4"]}
    assert not ray_executor._probe(str(tmp_path), "probe", "of another folder", [])["sees"]
    assert not ray_executor._probe(str(tmp_path / "nowhere"), "probe", "token", [])["sees"]


GOOD = {"version": __version__, "sees": True, "missing": []}


@pytest.mark.parametrize(("answer", "error", "facts"), [
    (GOOD | {"version": "0.0.1"}, BackendError, ["0.0.1", __version__]),
    (GOOD | {"sees": False}, WorkspaceError, ["/shared/out"]),
    (GOOD | {"missing": ["/a.mp4"]}, WorkspaceError, ["/a.mp4"]),
    ("No module named 'recon_cli'", BackendError, ["no recon"]),
    ("unreachable", BackendError, ["answer"]),
])
def test_a_machine_that_cannot_run_a_command_is_refused(
        ray_executor, monkeypatch, answer, error, facts):
    def get(found, **_):
        if isinstance(found, str):
            raise ray_executor.ray.exceptions.RaySystemError(found)
        return found

    monkeypatch.setattr(ray_executor.ray, "get", get)
    with raises(error, "10.0.0.2", *facts):
        ray_executor._check_node("10.0.0.2", answer, Path("/shared/out"))


def words_of(source, workspace):
    settings = (f"train.iterations={STEPS}", "train.max_size=32",
                f"train.checkpoint_every={SAVE_EVERY}")
    return ("run", str(source), "-w", str(workspace), "--threads", "1", "--no-prune",
            *(part for text in settings for part in ("--set", text)))


def wait_for(found, seconds=120):
    end = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return value


def saved_steps(workspace):
    partial = Workspace(workspace).partial_run("train")
    return partial.done if partial else 0


def training_process(workspace):
    """Returns the process that trains on a workspace, wherever it runs."""
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        if "recon_cli" in words and str(workspace) in words:
            return process
    return None


@pytest.fixture
def cluster(ray_clusters, monkeypatch):
    yield from ray_clusters.cluster_for(monkeypatch)


@pytest.mark.slow
def test_a_killed_node_costs_no_result(ray_executor, ray_clusters, cluster, tmp_path):
    source = make_replica(tmp_path / "room", frames=6, tests=0)
    expected, workspace = tmp_path / "expected", tmp_path / "out" / "room"
    subprocess.run(
        [sys.executable, "-m", "recon_cli", *words_of(source, expected)], check=True,
        capture_output=True)
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=ray_clusters.STORE_BYTES)
             for _ in range(2)]
    cluster.wait_for_nodes()
    executor = ray_executor.RayExecutor.connect(
        cores=1, gpu=False, slots=None, folder=tmp_path, inputs=[source])
    assert executor.slots == 2
    command = Command(words_of(source, workspace), workspace, tmp_path / "room.log")
    killed = []

    def kill():
        wait_for(lambda: saved_steps(workspace) >= 2 * SAVE_EVERY)
        lost = ray_clusters.node_of(training_process(workspace), nodes)
        cluster.remove_node(lost, allow_graceful=False)
        killed.append(saved_steps(workspace))

    thread = threading.Thread(target=kill)
    thread.start()
    assert executor.run(command) == 0
    thread.join()
    assert killed[0] < STEPS
    for name in ("train/splats.ply", "export/splats.ply"):
        assert (workspace / name).read_bytes() == (expected / name).read_bytes(), name


@pytest.mark.slow
def test_a_lost_head_is_an_error_and_the_work_so_far_is_kept(ray_clusters, tmp_path):
    source = make_replica(tmp_path / "room", frames=6, tests=0)
    out, log = tmp_path / "out", tmp_path / "log.txt"
    workspace = out / "room"
    words = words_of(source, workspace)[4:]
    batch = [sys.executable, "-m", "recon_cli", "batch", str(source), "--out", str(out), *words]
    made = ray_clusters.start_cluster(cpus=1)
    with log.open("wb") as output, subprocess.Popen(
            [*batch, "--on", "ray"], stdout=output, stderr=subprocess.STDOUT,
            env={**os.environ, "RAY_ADDRESS": made.address}) as process:
        wait_for(lambda: saved_steps(workspace) >= SAVE_EVERY)
        training = training_process(workspace)
        training.suspend()  # or it may end before anybody misses the head
        for daemon in psutil.Process(os.getpid()).children(recursive=True):
            if daemon.name() == "gcs_server":
                daemon.send_signal(signal.SIGKILL)
        code = process.wait(120)
    training.kill()
    made.shutdown()
    text = log.read_text()
    assert code == BackendError.exit_code, text
    assert_facts(text, "head", "cluster", "lost")
    done = subprocess.run(batch, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (workspace / "export" / "splats.ply").exists()
