"""Runs jobs of one kind on an executor, shows how far each is, and says why some failed.

Captures of a batch, segments of sfm and blocks of a training are such jobs: commands in folders of
their own, of which each may fail alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import ExitCode, WorkspaceError, list_names
from recon_cli.jobs.executor import TRIES, Command, Executor
from recon_cli.progress import Bar, Progress

_LOOK_SECONDS = 1.0  # between two looks at how far a job is


@dataclass(frozen=True)
class SharedJob:
    """A command, and how to see how far it is."""

    name: str  # of its bar
    command: Command
    look: Callable[[], tuple[float, str]]  # the share that is done, 0 to 1, and its activity
    weight: float = 1.0  # among all jobs
    # called right before it starts; a reason that it returns keeps the job from running
    prepare: Callable[[], str] = lambda: ""


@dataclass(frozen=True)
class JobEnd:
    """How a job ended."""

    code: int  # exit code
    reason: str  # why it failed; empty where it did not


def run_jobs(
    jobs: Sequence[SharedJob], executor: Executor, progress: Progress, *,
    record: Callable[[float], None] = lambda _share: None,
    report: Callable[[SharedJob, JobEnd], None] = lambda _job, _end: None,
) -> list[JobEnd]:
    """Runs jobs, as many at once as the executor has slots, and returns how each ended.

    A job that fails stops no other. `record` gets the share of all work that is done, and `report`
    each job when it has ended. Where the machines are lost, the user interrupts or `report` raises,
    running commands are stopped.

    Raises:
        BackendError: the machines cannot be reached any more.
    """
    shares, lock = [_look(job)[0] for job in jobs], threading.Lock()  # done before
    total = sum(job.weight for job in jobs)

    def look(index: int) -> tuple[int, str]:
        share, text = _look(jobs[index])
        with lock:
            shares[index] = share
            record(sum(job.weight * part for job, part in zip(jobs, shares, strict=True)) / total)
        return int(100 * share), text

    def run(index: int) -> JobEnd:
        job = jobs[index]
        try:
            reason = job.prepare()
            if reason:
                return JobEnd(ExitCode.RECONSTRUCTION, reason)
            with progress.bar(job.name, 100, unit="%") as bar, _watching(bar, lambda: look(index)):
                code = executor.run(job.command)
            look(index)
        except OSError as error:  # of a full disk, say
            return JobEnd(WorkspaceError.exit_code, str(error))
        return JobEnd(code, _find_reason(job.command.log, code))

    ends: dict[int, JobEnd] = {}
    with ThreadPoolExecutor(executor.slots) as threads:
        futures = {threads.submit(run, index): index for index in range(len(jobs))}
        try:
            for future in _as_they_end(futures):
                index = futures[future]
                ends[index] = future.result()
                report(jobs[index], ends[index])
        except BaseException:
            for future in futures:
                future.cancel()
            executor.stop()
            raise
    return [ends[index] for index in range(len(jobs))]


def describe_failures(failed: Mapping[str, str], total: int, noun: str) -> str:
    """Returns in a sentence how many of `total` failed and why; `failed` are reasons by name."""
    reasons = list_names([f"{name}: {reason.rstrip('.')}" for name, reason in failed.items()])
    return f"{len(failed)} of {total} {noun} failed ({reasons})."


def _as_they_end(futures: Iterable[Future[JobEnd]]) -> Iterator[Future[JobEnd]]:
    """Yields futures as they end; Ctrl-C on Windows waits for the end of a wait."""
    left = list(futures)
    while left:
        done, _ = wait(left, timeout=_LOOK_SECONDS, return_when=FIRST_COMPLETED)
        yield from (future for future in left if future in done)
        left = [future for future in left if future not in done]


def _look(job: SharedJob) -> tuple[float, str]:
    """Returns how far a job is; nothing where its folder cannot be read, of which it tells."""
    try:
        return job.look()
    except OSError:
        return 0.0, ""


@contextmanager
def _watching(bar: Bar, look: Callable[[], tuple[int, str]]) -> Iterator[None]:
    """Shows on a bar the percentage done and the activity that `look` returns."""
    ended = threading.Event()

    def watch() -> None:
        shown = 0
        while not ended.wait(_LOOK_SECONDS):
            done, text = look()
            bar.note(text)
            bar.advance(max(0, done - shown))
            shown = max(done, shown)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _find_reason(log: Path, code: int) -> str:
    """Returns why a command failed, by its last error message; empty where it did not."""
    if code == 0:
        return ""
    if code == ExitCode.INTERRUPTED:
        return "interrupted"
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    _, found, message = text.rpartition("\nerror: " if "\nerror: " in text else "error: ")
    if found:
        return message.partition("\nhint: ")[0].strip()
    if code > ExitCode.SIGNAL:
        return f"its process was killed by signal {code - ExitCode.SIGNAL}, {TRIES} times"
    return text.strip().splitlines()[-1] if text.strip() else "it left no message"
