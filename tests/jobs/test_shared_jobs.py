import dataclasses

import pytest
from facts import assert_facts, raises

from recon_cli.errors import BackendError
from recon_cli.jobs.executor import Command
from recon_cli.jobs.shared_jobs import JobEnd, SharedJob, describe_failures, run_jobs
from recon_cli.progress import NullProgress


class Fake:
    """Stands for an executor: returns a code by the command's first word, or raises that."""

    slots = 1

    def __init__(self):
        self.ran, self.stopped = [], False

    def run(self, command):
        self.ran.append(command.workspace.name)
        if isinstance(command.words[0], BaseException):
            raise command.words[0]
        return command.words[0]

    def stop(self):
        self.stopped = True


def make_job(tmp_path, name, code, **others):
    command = Command((code,), tmp_path / name, tmp_path / f"{name}.log")
    return SharedJob(name, command, lambda: (float(code == 0), ""), **others)


def test_a_job_that_fails_or_is_not_to_run_stops_no_other(tmp_path):
    executor, ended = Fake(), []
    jobs = [make_job(tmp_path, "a", 0), make_job(tmp_path, "b", 3),
            make_job(tmp_path, "c", 0, prepare=lambda: "no time"),
            make_job(tmp_path, "d", OSError("full")), make_job(tmp_path, "e", 0)]
    (tmp_path / "b.log").write_text("error: It is dark.\nhint: Light.\n")
    ends = run_jobs(
        jobs, executor, NullProgress(), report=lambda job, _: ended.append(job.name))
    assert ends == [JobEnd(0, ""), JobEnd(3, "It is dark."), JobEnd(5, "no time"),
                    JobEnd(7, "full"), JobEnd(0, "")]
    assert sorted(ended) == list("abcde")
    assert executor.ran == list("abde")
    assert not executor.stopped


@pytest.mark.parametrize("broken", [BackendError("gone"), KeyboardInterrupt()])
def test_lost_machines_and_an_interrupt_stop_what_runs(tmp_path, broken):
    executor = Fake()
    with pytest.raises(type(broken)):
        run_jobs([make_job(tmp_path, "a", broken)], executor, NullProgress())
    assert executor.stopped


def test_whoever_gets_the_ends_may_stop_all(tmp_path):
    def refuse(_job, end):
        raise ValueError(end.code)

    executor = Fake()
    with raises(ValueError, 3):
        run_jobs([make_job(tmp_path, "a", 3)], executor, NullProgress(), report=refuse)
    assert executor.stopped


def test_the_share_of_all_work_counts_jobs_by_their_weight(tmp_path):
    shares = []
    run_jobs([make_job(tmp_path, "a", 0, weight=3), make_job(tmp_path, "b", 1)], Fake(),
             NullProgress(), record=shares.append)
    assert shares == [0.75, 0.75]


def test_a_folder_that_cannot_be_read_counts_as_nothing_done(tmp_path):
    def refuse():
        raise PermissionError

    job, shares = make_job(tmp_path, "a", 0), []
    job = dataclasses.replace(job, look=refuse)
    assert run_jobs([job], Fake(), NullProgress(), record=shares.append) == [JobEnd(0, "")]
    assert shares == [0.0]


def test_failures_are_counted_and_named():
    failed = {str(index): "It is dark." for index in range(7)}
    assert_facts(describe_failures({"a": "It is dark."}, 3, "rooms"), 1, 3, "a", "dark")
    assert_facts(describe_failures(failed, 9, "rooms"), 4, 2, "dark")
