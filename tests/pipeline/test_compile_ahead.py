"""Kernels are compiled in a process beside the stages that come before training."""

import logging
import os
import sys
import time
from pathlib import Path

import psutil
import pytest
from facts import assert_facts
from fake_stages import TABLE
from numba_runs import copy_cache

from recon_cli import processes
from recon_cli.config.stages import ComputeConfig
from recon_cli.pipeline import compile_ahead
from recon_cli.pipeline.plan import Job
from recon_cli.render import registry
from recon_cli.stereo import depths
from recon_cli.train import compile_worker
from recon_cli.workspace.layout import Workspace

SECONDS = 20.0  # for a process to start or end on a busy machine


def job_in(folder: Path, **compute: str) -> Job:
    return Job(Workspace(folder), compute=ComputeConfig(**compute), table=TABLE)


EARLIER: set[int] = set()  # children of this process before the test, left by others


@pytest.fixture(autouse=True)
def _cold(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("RECON_CACHE_DIR", str(tmp_path / "cache"))
    EARLIER.clear()
    EARLIER.update(child.pid for child in psutil.Process().children())


@pytest.fixture
def worker(tmp_path, monkeypatch):
    """Lets a script take the place of the interpreter that compiles; returns its writer."""
    script = tmp_path / "python"

    def write(text: str) -> None:
        script.write_text(f"#!/bin/sh\n{text}\n")
        script.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(script))

    return write


def children(*, alive: bool) -> list[psutil.Process]:
    """Returns the child processes, once there are some that have ended or that are alive."""
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline:
        found = [one for one in psutil.Process().children() if one.pid not in EARLIER]
        if any((one.status() != psutil.STATUS_ZOMBIE) is alive for one in found):
            return found
        time.sleep(0.01)
    return []


needs_shell = pytest.mark.skipif(sys.platform == "win32", reason="the process is a shell script")


@pytest.mark.integration
@needs_shell
def test_the_process_ends_with_the_stages_even_where_they_fail(tmp_path, worker):
    worker("exec sleep 60")
    started = []

    def fail() -> None:
        with compile_ahead.compile_ahead(job_in(tmp_path), ["ingest", "train"], again=False):
            started.extend(children(alive=True))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert len(started) == 1
    assert not started[0].is_running()


@pytest.mark.integration
@needs_shell
def test_a_failure_goes_to_the_log_and_not_to_the_terminal(tmp_path, worker, caplog, capfd):
    worker("echo out of memory >&2; exit 3")
    with (caplog.at_level(logging.DEBUG, "recon"),
          compile_ahead.compile_ahead(job_in(tmp_path), ["ingest", "train"], again=False)):
        assert children(alive=False)
    assert_facts(caplog.text, 3, "ended", "memory")
    assert all(record.levelno == logging.DEBUG for record in caplog.records)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("stages", "finished", "again", "compute", "beside"), [
    (["ingest", "denoise", "sfm", "place", "train"], [], False, {}, True),
    (["train"], ["ingest", "denoise"], False, {}, True),  # sfm runs first
    (["train"], ["ingest", "denoise", "sfm", "place"], False, {}, False),
    (["train"], ["ingest", "denoise", "sfm", "place"], True, {}, False),
    (["sfm", "place", "train"], ["ingest", "denoise", "sfm", "place"], True, {}, True),
    (["ingest", "denoise", "sfm"], [], False, {}, False),
    (["ingest", "train"], [], False, {"backend": "numba", "device": "cpu"}, True),
    (["ingest", "train"], [], False, {"backend": "torch"}, False),
    (["ingest", "train"], [], False, {"device": "cuda"}, False),  # no driver of a GPU
    (["ingest", "train"], [], False, {"backend": "triton"}, False)])
def test_a_process_starts_only_where_stages_that_render_wait_for_others(
        tmp_path, stages, finished, again, compute, beside):
    for name in finished:
        (tmp_path / name).mkdir()
    commands = starts(tmp_path, stages, again=again, **compute)
    assert commands == [["recon_cli.train.compile_worker", compute.get("backend", "auto"),
                         compute.get("device", "auto")]] * beside


@pytest.mark.parametrize(("backend", "device", "beside"), [
    ("auto", "auto", True), ("auto", "cuda", True), ("triton", "auto", True),
    ("auto", "cpu", True), ("numba", "cuda", False), ("torch", "cuda", False)])
def test_with_a_driver_of_a_gpu_its_kernels_are_compiled_too(
        tmp_path, monkeypatch, backend, device, beside):
    driver = tmp_path / "version"
    driver.touch()
    monkeypatch.setattr(compile_ahead, "_DRIVER", driver)
    assert bool(starts(tmp_path, ["ingest", "train"], backend=backend, device=device)) is beside


@pytest.mark.parametrize(("mark", "package"), [
    ("kernels/0123/ready", "numba"), ("self-check/triton-0123.json", "triton")])
@pytest.mark.parametrize(("age", "beside"), [(-100, False), (100, True)])
def test_kernels_of_an_earlier_installation_do_not_count(
        tmp_path, monkeypatch, mark, package, age, beside):
    source = tmp_path / "sources" / "render" / package / "kernel.py"
    source.parent.mkdir(parents=True)
    source.touch()
    monkeypatch.setattr(compile_ahead, "_SOURCES", tmp_path / "sources")
    monkeypatch.setattr(compile_ahead, "_DRIVER", source)
    monkeypatch.setattr(compile_ahead.importlib.util, "find_spec", lambda _: None)
    mark = tmp_path / "cache" / mark
    mark.parent.mkdir(parents=True)
    mark.touch()
    installed = source.stat().st_ctime
    os.utime(mark, (installed - age, installed - age))
    assert bool(starts(tmp_path, ["ingest", "train"], backend=package)) is beside


def starts(folder, stages, *, again=False, **compute):
    """Returns the commands of the processes that would be started for stages, run by nobody."""
    commands = []

    class Child:
        def __init__(self, command, **_options):
            commands.append(command[-3:])

        def __enter__(self):
            return self

        def __exit__(self, *_exc):
            pass

        def poll(self):
            return 0

        kill = poll

        def wait(self, _timeout):
            pass

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes.subprocess, "Popen", Child)
        with compile_ahead.compile_ahead(job_in(folder, **compute), stages, again=again):
            pass
    return commands


@pytest.mark.parametrize(("backend", "device", "cuda", "compiles"), [
    ("auto", "auto", False, "numba"), ("auto", "auto", True, "triton"),
    ("auto", "cpu", True, "numba"), ("numba", "cpu", True, "numba"), ("torch", "cpu", False, None),
    ("torch", "cuda", True, None), ("triton", "auto", True, "triton"),
    ("auto", "cuda", True, "triton")])
def test_the_process_compiles_what_the_options_come_to(
        monkeypatch, backend, device, cuda, compiles):
    prepared = []
    monkeypatch.setattr(registry.torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(registry, "kernels_to_compile", lambda name: 12 * (name == "numba"))
    monkeypatch.setattr(registry, "use_threads", lambda *_: None)
    monkeypatch.setattr(registry, "prepare", lambda name, _: prepared.append(name) or 0.0)
    monkeypatch.setattr(registry, "cuda_verdict", lambda: prepared.append("triton"))
    monkeypatch.setattr(compile_worker.depths, "compile_kernels", lambda: prepared.append("stereo"))
    compile_worker.compile_kernels(backend, device)
    assert prepared == [*([compiles] if compiles else []), "stereo"]


@pytest.mark.compile
def test_the_process_fills_the_cache_that_the_stages_read(tmp_path):
    # all but two kernels, of the rasterizer and of stereo, and the mark that nothing is missing
    depths.compile_kernels()
    folder = copy_cache(tmp_path / "cache")
    missing = [*folder.glob("*/optimizer.adam-*"), *folder.glob("*/kernels.compare-*"),
               folder / "ready"]
    assert len(missing) == 3
    for path in missing:
        path.unlink()
    assert starts(tmp_path, ["ingest", "train"])
    with compile_ahead.compile_ahead(job_in(tmp_path), ["ingest", "train"], again=False):
        (child,) = children(alive=True)
        deadline = time.monotonic() + SECONDS
        while child.nice() <= psutil.Process().nice():  # until it has begun
            assert time.monotonic() < deadline
            time.sleep(0.01)
        child.wait(300)
    assert all(path.exists() for path in missing)
    assert not starts(tmp_path, ["ingest", "train"])
