"""The mapping process: its failures, its log, and what its events say."""

from contextlib import nullcontext
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from recon_cli.progress import NullProgress
from recon_cli.sfm.job import STEPS, Phase
from recon_cli.sfm.mapping import process
from recon_cli.sfm.mapping.process import Monitor, TimeUpError, last_error, run_job
from recon_cli.workspace.steps import StepFolder

GLOG = "I20260101 10:00:00.000001 139 timer.cc:90] Elapsed time: 0.1 [minutes]\n"


def written(tmp_path, text):
    path = tmp_path / "log.txt"
    path.write_text(text)
    return path


def test_the_last_error_of_a_log_is_its_gist(tmp_path):
    log = written(tmp_path, GLOG + (
        "E20260101 10:00:00.000002 139 images.cc:55] b.png BITMAP_ERROR: Failed to read.\n"
        "F20260101 10:00:00.000003 139 pose.cc:12] Check failed: x > 0\n") + GLOG)
    assert last_error(log) == "Check failed: x > 0"


def test_the_error_of_python_is_found(tmp_path):
    log = written(tmp_path, GLOG + (
        "Traceback (most recent call last):\n  File x, line 1\nMemoryError: no room\n"))
    assert last_error(log) == "MemoryError: no room"


def test_native_stack_frames_are_passed_over(tmp_path):
    log = written(tmp_path, GLOG + "free(): invalid pointer\n    @ 0x7f _Py_FatalErrorFormat\n")
    assert last_error(log) == "free(): invalid pointer"


def test_without_an_error_the_last_line_is_taken(tmp_path):
    assert last_error(written(tmp_path, GLOG)) == "Elapsed time: 0.1 [minutes]"


def test_an_empty_log_says_nothing(tmp_path):
    assert last_error(written(tmp_path, "")) == "nothing."


def test_only_the_end_of_a_long_log_is_read(tmp_path):
    assert last_error(written(tmp_path, "Error: long ago\n" + GLOG * 2000)) == (
        "Elapsed time: 0.1 [minutes]")


@pytest.mark.parametrize(("events", "idle"), [
    ([Phase("features", 4, 0), 4, Phase("matches", 6, 0), 5], 0),
    ([Phase("matches", 6, 0), 5, 6, Phase("mapping", 4, 0), 4], 1),
    ([Phase("matches", 6, 6)], 1),  # kept from an interrupted run
    ([Phase("mapping", 4, 0), 2, Phase("matches", 6, 6), Phase("mapping", 4, 0)], 1)])
def test_a_core_is_reported_idle_once_when_all_pairs_are_matched(events, idle):
    job, calls = SimpleNamespace(names=("a.png",) * 4, steps=STEPS), []
    with Monitor(job, NullProgress(), lambda *_: None, lambda: calls.append(1)) as monitor:
        for event in events:
            monitor.show(event)
    assert len(calls) == idle


@dataclass
class Attempts:
    """What a job needs to know of itself here."""

    tried: StepFolder
    max_minutes: float = 5.0


@pytest.mark.parametrize("tried", [True, False])
def test_when_the_time_is_up_the_best_attempt_that_ended_is_the_result(
        tmp_path, monkeypatch, tried):
    runs = []

    def run(job, limit, _):
        runs.append((job.max_minutes, limit))
        if len(runs) == 1:
            raise TimeUpError("The cameras were not found within 5 minutes.")

    monkeypatch.setattr(process, "_run", run)
    monkeypatch.setattr(process, "Monitor", lambda *_: None)
    attempts = Attempts(StepFolder(tmp_path, key="of these matches"))
    if tried:
        attempts.tried.finish("exhaustive")
    with nullcontext() if tried else pytest.raises(TimeUpError):
        run_job(attempts, progress=NullProgress(), record=print, on_idle=print)
    assert runs == [(5.0, 5.0), (0.0, 5.0)][:1 + tried]
