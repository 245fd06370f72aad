"""Tables of experiments, and what becomes of their files and pictures."""

from __future__ import annotations

from pathlib import Path

import pytest

from recon_cli.evaluation.scores import Table, number, percent
from recon_cli.experiments import outputs
from recon_cli.experiments.outputs import Result
from recon_cli.machine import cpu_model, install_command


def test_numbers_keep_their_digits() -> None:
    assert [number(x) for x in (None, 0.0, 12.345, 0.01234, 1234.5, 1.234e-6, 5e7)] == [
        "-", "0", "12.3", "0.0123", "1234", "1.23e-06", "5.00e+07"]
    assert [percent(x) for x in (None, 0.25, 0.00123)] == ["-", "25%", "0.123%"]


def test_a_table_is_aligned_as_text_and_piped_as_markdown() -> None:
    table = Table(("what", "n"), [("one", "1"), ("three", "3.5")], "Title")
    assert table.text() == "Title\nwhat     n\none      1\nthree  3.5"
    assert table.markdown() == (
        "### Title\n\n| what | n |\n| --- | ---: |\n| one | 1 |\n| three | 3.5 |")


def test_the_model_of_the_cpu_is_read_from_cpuinfo(tmp_path: Path) -> None:
    path = tmp_path / "cpuinfo"
    path.write_text("processor\t: 0\nmodel name\t: A: CPU\nmodel name\t: B\n")
    assert cpu_model(path) == "A: CPU"
    assert cpu_model(tmp_path / "none")


def test_without_matplotlib_the_figures_are_kept_and_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(outputs.importlib.util, "find_spec", lambda _name: None)
    with caplog.at_level("WARNING", "recon"):
        Result({"a": 1}, "", (), draw=lambda _path: pytest.fail("drawn")).save(tmp_path, "study")
    assert (tmp_path / "study.json").is_file()
    assert install_command("plot") in caplog.text
