import signal
import threading
import time

import pytest

from recon_cli.jobs import executor
from recon_cli.jobs.executor import Command, LocalExecutor

pytestmark = pytest.mark.floors

# Stands for recon: counts its starts in the folder in which it runs, and does what it is told.
STAND_IN = """
import os, pathlib, signal, sys, time
signal.signal(signal.SIGTERM, signal.default_int_handler)
starts = pathlib.Path("starts")
starts.write_text(starts.read_text() + "x" if starts.exists() else "x")
count, what = len(starts.read_text()), sys.argv[-1]
print("argument", what, flush=True)
if what == "die-once" and count == 1 or what == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if what == "end-once" and count == 1:
    raise SystemExit(143)
if what == "wait":
    try:
        pathlib.Path("waiting").touch()
        time.sleep(600)
    except KeyboardInterrupt:
        pathlib.Path("saved").touch()
        raise SystemExit(143)
raise SystemExit(int(what) if what.isdigit() else 0)
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "stand_in.py").write_text(STAND_IN, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setattr(executor, "PROGRAM", "stand_in")


def command(tmp_path, *words):
    return Command(words, tmp_path / "scene", tmp_path / "scene.log")


def starts(tmp_path):
    return len((tmp_path / "starts").read_text())


@pytest.mark.integration
@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("code", [0, 3])
def test_the_exit_code_comes_back_and_what_was_printed_is_in_the_log(tmp_path, code):
    assert LocalExecutor(1).run(command(tmp_path, str(code))) == code
    assert (tmp_path / "scene.log").read_text() == f"argument {code}\n"
    assert starts(tmp_path) == 1


@pytest.mark.integration
@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("how", ["die-once", "end-once"])
def test_a_command_whose_process_was_killed_is_run_again(tmp_path, how):
    assert LocalExecutor(1).run(command(tmp_path, how)) == 0
    assert starts(tmp_path) == 2


@pytest.mark.integration
@pytest.mark.usefixtures("stand_in")
def test_a_command_that_is_always_killed_is_given_up_with_the_code_of_a_shell(tmp_path):
    assert LocalExecutor(1).run(command(tmp_path, "die")) == 128 + signal.SIGKILL
    assert starts(tmp_path) == executor.TRIES


def run_in_thread(local, given):
    codes = []
    thread = threading.Thread(target=lambda: codes.append(local.run(given)))
    thread.start()
    return thread, codes


@pytest.mark.integration
@pytest.mark.usefixtures("stand_in")
def test_a_command_that_is_stopped_saves_what_it_has_and_none_starts_afterwards(tmp_path):
    local = LocalExecutor(1)
    thread, codes = run_in_thread(local, command(tmp_path, "wait"))
    while not (tmp_path / "waiting").exists():
        time.sleep(0.01)
    local.stop()
    thread.join()
    assert codes == [130]
    assert (tmp_path / "saved").exists()
    assert local.run(command(tmp_path, "0")) == 130
    assert starts(tmp_path) == 1


@pytest.mark.integration
@pytest.mark.usefixtures("stand_in")
def test_a_command_waits_for_a_process_that_still_holds_the_workspace(tmp_path):
    (tmp_path / "scene").mkdir()
    lock = executor.FileLock(tmp_path / "scene" / executor.LOCK)
    lock.acquire()
    thread, codes = run_in_thread(LocalExecutor(1), command(tmp_path, "0"))
    time.sleep(0.3)
    assert not (tmp_path / "starts").exists()
    lock.release()
    thread.join()
    assert codes == [0]
