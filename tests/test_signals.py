"""Signals that end a command: one line, a shell's exit code, no process left."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from facts import assert_facts

from recon_cli import signals
from recon_cli.errors import ExitCode
from recon_cli.signals import Interrupted, deferring, describe_end, exit_code, raising

CODES = {signal.SIGINT: ExitCode.INTERRUPTED, signal.SIGTERM: ExitCode.TERMINATED,
         signal.SIGHUP: ExitCode.HANGUP}


def send(number):
    os.kill(os.getpid(), number)
    time.sleep(0.01)  # Python looks between two of its instructions


@pytest.mark.parametrize("number", CODES)
def test_each_signal_interrupts_and_has_the_exit_code_of_a_shell(number):
    outside = signal.signal(number, signal.default_int_handler)  # which nohup ignores
    try:
        with pytest.raises(KeyboardInterrupt) as raised, raising():
            send(number)
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, outside)
    assert exit_code(raised.value) == CODES[number]
    assert_facts(describe_end(raised.value), "again")


def test_a_signal_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with raising():
            send(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.integration
@pytest.mark.parametrize("number", CODES)
def test_a_signal_at_the_very_end_does_not_change_the_exit_code(number):
    code = (f"import os, sys\nfrom recon_cli.__main__ import main\nclass Last:\n"
            f"    def __del__(self, kill=os.kill, process=os.getpid()): kill(process, {number})\n"
            "last, sys.argv = Last(), ['recon', '--version']\nsys.exit(main())")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_native_module_whose_import_takes_a_signal_does_not_hide_it():
    """Seen with modules by pybind11: "ImportError: initialization failed" in its place."""
    def start():
        try:
            signal.raise_signal(signal.SIGTERM)
        except Interrupted as error:
            raise ImportError("initialization failed") from error

    with pytest.raises(Interrupted) as caught, raising():
        start()
    assert caught.value.number == signal.SIGTERM
    with pytest.raises(ImportError), raising():
        raise ImportError("no such module")


def test_a_signal_that_is_sent_twice_at_once_counts_once():
    done = []

    def work():
        with raising():
            try:
                send(signal.SIGTERM)
            finally:
                send(signal.SIGTERM)
                done.append("what is done on the way out")

    with pytest.raises(Interrupted):
        work()
    assert done


def test_a_deferred_signal_cuts_nothing_and_is_not_lost(monkeypatch):
    seen = []

    def work():
        with deferring() as ended:
            seen.append(ended())
            send(signal.SIGTERM)
            seen.append(ended())

    with pytest.raises(Interrupted) as raised:
        work()
    assert seen == [0, signal.SIGTERM]
    assert exit_code(raised.value) == ExitCode.TERMINATED

    def insist():
        with deferring():
            send(signal.SIGTERM)
            send(signal.SIGTERM)
            pytest.fail("the second one waits no longer")

    monkeypatch.setattr(signals, "_TWICE_SECONDS", 0.0)
    with pytest.raises(Interrupted):
        insist()


@pytest.mark.integration
def test_a_later_signal_ends_the_process_at_once():
    code = ("import os, signal, sys, time\n"
            "from recon_cli import signals\n"
            "with signals.raising():\n"
            "    try:\n"
            "        os.kill(os.getpid(), signal.SIGTERM)\n"
            "        time.sleep(60)\n"
            "    finally:\n"
            "        signals._TWICE_SECONDS = 0.0\n"
            "        os.kill(os.getpid(), signal.SIGINT)\n"
            "        time.sleep(60)\n")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (ExitCode.INTERRUPTED, b"")


@pytest.mark.integration
@pytest.mark.parametrize("in_thread", [False, True])
def test_native_code_that_takes_a_signal_gives_it_back(in_thread):
    code = ("import os, signal, threading, time\n"
            "from recon_cli import signals\n"
            "with signals.raising():\n"
            "    try:\n"
            "        thread = threading.Thread(target=__import__,\n"
            "                                  args=('recon_cli.io.colmap_library',))\n"
            f"        thread.{'start' if in_thread else 'run'}()\n"
            f"        {'thread.join()' if in_thread else 'pass'}\n"
            "        os.kill(os.getpid(), signal.SIGTERM)\n"
            "        time.sleep(60)\n"
            "    except KeyboardInterrupt as error:\n"
            "        raise SystemExit(signals.exit_code(error))\n")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (ExitCode.TERMINATED, b"")


def test_a_thread_other_than_the_first_leaves_signals_alone():
    seen = []

    def work():
        with raising(), deferring() as ended:
            seen.append(ended())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [0]


@pytest.mark.integration
@pytest.mark.parametrize("number", CODES)
@pytest.mark.parametrize("seconds", [0.08, 0.3, 1.0])
def test_a_program_that_is_ended_says_so_in_one_line(tmp_path, number, seconds, sample_video):
    with subprocess.Popen([sys.executable, "-m", "recon_cli", "ingest", str(sample_video), "-w",
                           str(tmp_path / "w")], stderr=subprocess.PIPE, stdout=subprocess.PIPE,
                          ) as process:
        time.sleep(seconds)
        process.send_signal(number)
        said = process.communicate()[1].decode()
    starting = "KeyboardInterrupt" in said and "recon_cli" not in said  # Python itself, in `site`
    if process.returncode in (-number, 0) or starting:
        pytest.skip("it was not yet, or no longer, at work")
    assert process.returncode == CODES[number]
    lines = [line for line in said.splitlines() if "%" not in line and line.strip()]  # no progress
    assert lines == [describe_end(Interrupted(number))]
