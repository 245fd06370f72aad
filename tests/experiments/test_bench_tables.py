"""Tables and ratios of `recon bench`: pure functions of known inputs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from recon_cli.errors import ConfigError, InputError, ReconError
from recon_cli.evaluation.scores import Table, number, percent
from recon_cli.experiments import outputs
from recon_cli.experiments.bench_measure import (
    SCHEMA,
    BackendResult,
    BenchedScene,
    BenchResult,
    Speed,
)
from recon_cli.experiments.bench_scene import Accuracy
from recon_cli.experiments.instruments import Host, Timing, alternate
from recon_cli.experiments.outputs import Result
from recon_cli.experiments.rasterizer_benchmark import (
    BenchRequest,
    head,
    parse_size,
    tables,
)
from recon_cli.machine import cpu_model, install_command

EXACT = Accuracy(1e-6, 1e-7, 0.0, 2e-6, "means", 1.0)


def speed(threads: int, ms: float) -> Speed:
    """A backend whose forward pass takes `ms`, the backward pass twice and the step four times."""
    return Speed(threads, {
        "forward": Timing(ms, 0.1), "backward": Timing(2 * ms, 0.2),
        "step": Timing(4 * ms, 0.4)})


def backend(ms: float) -> BackendResult:
    return BackendResult(speed(2, ms), speed(1, 1.5 * ms), EXACT, 10**7)


def result(numba_ms: float = 10.0, torch_ms: float = 80.0) -> BenchResult:
    host = Host("A CPU", 2, 2, 16, "cpu", {"torch": "2", "numpy": "2", "python": "3"})
    scene = BenchedScene(
        1000, 64, 48, 3, {"numba": backend(numba_ms), "torch": backend(torch_ms)})
    return BenchResult(host, 7, {"room": scene})


# ---- medians and rates ----

def test_a_timing_is_median_and_interquartile_range() -> None:
    assert Timing.from_samples([5.0, 1.0, 2.0, 4.0, 3.0]) == Timing(3.0, 2.0)
    assert Timing.from_samples([2.0, 4.0]) == Timing(3.0, 1.0)
    assert Timing.from_samples([7.0]) == Timing(7.0, 0.0)
    with pytest.raises(ValueError, match="no samples"):
        Timing.from_samples([])


def test_candidates_take_turns_and_the_first_round_is_not_counted() -> None:
    order: list[str] = []
    rounds: list[int] = []

    def work(name: str):
        def run() -> dict[str, float]:
            order.append(name)
            return {"all": float(len(order))}

        return run

    found = alternate({"a": work("a"), "b": work("b")}, 2, lambda: rounds.append(1))
    assert order == ["a", "b"] * 3
    assert found == {"a": {"all": [3.0, 5.0]}, "b": {"all": [4.0, 6.0]}}
    assert len(rounds) == 3


# ---- tables ----

def test_numbers_keep_their_digits() -> None:
    assert [number(x) for x in (None, 0.0, 12.345, 0.01234, 1234.5, 1.234e-6, 5e7)] == [
        "-", "0", "12.3", "0.0123", "1234", "1.23e-06", "5.00e+07"]
    assert [percent(x) for x in (None, 0.25, 0.00123)] == ["-", "25%", "0.123%"]


def test_a_table_is_aligned_as_text_and_piped_as_markdown() -> None:
    table = Table(("what", "n"), [("one", "1"), ("three", "3.5")], "Title")
    assert table.text() == "Title\nwhat     n\none      1\nthree  3.5"
    assert table.markdown() == (
        "### Title\n\n| what | n |\n| --- | ---: |\n| one | 1 |\n| three | 3.5 |")


def test_a_row_has_the_speed_and_the_error_of_a_backend() -> None:
    found = result()
    rows = {row[0]: row[1:] for row in tables(found)[0].rows}
    assert rows["numba"][:5] == ("30", "8.00x", "40 (0.4)", "60 (0.4)", "10")
    assert rows["torch"][:2] == ("240", "1.00x")
    assert rows["numba"][5:] == ("1.00e-06", "1.00e-07", "0%", "2.00e-06", "means", "0")
    assert "interquartile range" in head(found)
    assert "A CPU, 2 of 2 cores" in head(found)


# ---- the JSON file ----

def test_the_record_has_the_promised_keys() -> None:
    record = json.loads(json.dumps(result().record()))
    assert (record["schema"], record["version"]) == (SCHEMA, 2)
    assert record["machine"]["cpu"] == "A CPU"
    assert record["machine"]["versions"]["torch"] == "2"
    for one in record["scenes"]["room"]["backends"].values():
        assert one.keys() >= {"forward_ms", "step_iqr_ms", "image_error_max", "memory_bytes"}


def test_an_error_that_is_not_finite_is_null() -> None:
    broken = dataclasses.replace(backend(1.0), accuracy=dataclasses.replace(
        EXACT, image_error_max=float("inf")))
    assert broken.record()["image_error_max"] is None


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


# ---- what is asked ----

def request(**changes: object) -> BenchRequest:
    return BenchRequest(device="cpu", threads=1, **changes)


def test_a_size_is_two_numbers_of_parse_size() -> None:
    assert parse_size("640x360") == (640, 360)
    for text in ("640", "0x3", "3x0", "-1x2", "1x2x3", "axb", ""):
        with pytest.raises(ConfigError, match="WIDTHxHEIGHT"):
            parse_size(text)
    with pytest.raises(ReconError):
        request(size="large")


def test_quick_takes_fewer_rounds_unless_told() -> None:
    assert request().plan().rounds > request(quick=True).plan().rounds
    assert request(quick=True, rounds=5).plan().rounds == 5


def test_an_output_needs_its_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        request(out=tmp_path / "none" / "a.json")
