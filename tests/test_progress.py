"""Progress without a terminal: few lines, each with what is done."""

import logging
import threading

import pytest

from recon_cli import progress
from recon_cli.progress import LINE_SECONDS, TqdmProgress, in_stage


class Records(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.kept.append(record)


@pytest.fixture
def records(monkeypatch: pytest.MonkeyPatch) -> list[logging.LogRecord]:
    """Returns the list of records of progress, of a process that nobody watches."""
    handler = Records()
    monkeypatch.setattr(progress, "_pace", progress._Pace())
    progress.choose_bars(lambda: False)
    progress.logger.addHandler(handler)
    level = progress.logger.level
    progress.logger.setLevel(logging.INFO)
    yield handler.kept
    progress.logger.setLevel(level)
    progress.logger.removeHandler(handler)
    progress.choose_bars()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Returns a list whose only number is the time in seconds."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_stage_of_a_minute_has_at_most_four_lines_however_many_bars_it_has(
    records: list[logging.LogRecord], clock: list[float]
) -> None:
    with in_stage("sfm"):
        for label in ("features", "matching", "mapping"):
            with TqdmProgress().bar(label, 40, unit="image") as bar:
                for _ in range(40):
                    clock[0] += 0.5
                    bar.advance()
    assert clock == [60.0]
    lines = [record.getMessage() for record in records]
    assert len(lines) == 60 / LINE_SECONDS + 1
    assert lines[:2] == ["features 0/40 (0%)", "features 40/40 (100%)"]


def test_each_stage_begins_with_a_line_at_once(
    records: list[logging.LogRecord], clock: list[float]
) -> None:
    for name in ("ingest", "sfm"):
        with in_stage(name), TqdmProgress().bar(name, 10, done=4) as bar:
            bar.advance(6)
    assert clock == [0.0]
    assert [(record.stage, record.done, record.total) for record in records] == [
        ("ingest", 4, 10), ("sfm", 4, 10)]
    assert [record.getMessage() for record in records] == ["4/10 (40%)"] * 2


def test_a_line_says_how_long_the_rest_takes_and_what_stands_beside_the_bar(
    records: list[logging.LogRecord], clock: list[float]
) -> None:
    with TqdmProgress().bar("train", 100, done=50) as bar:
        bar.note("loss 0.02")
        clock[0] = 30.0
        bar.advance(30)
    with TqdmProgress().bar("room", 100, unit="%") as bar:
        clock[0] = 60.0
        bar.advance(25)
    assert [record.getMessage() for record in records] == [
        "train 50/100 (50%)", "train 80/100 (80%), 20.0 s left: loss 0.02",
        "room 25%, 1 min 30 s left"]


def test_threads_that_report_at_once_lose_no_step(records: list[logging.LogRecord]) -> None:
    with TqdmProgress().bar("frames", 8000) as bar:
        threads = [threading.Thread(target=lambda: [bar.advance() for _ in range(1000)])
                   for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert bar._done == 8000
    assert len(records) == 1
