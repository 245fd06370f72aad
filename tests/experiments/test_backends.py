"""`recon bench` in process: the errors that it finds are bounded, times are never asserted."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from facts import raises

from recon_cli.cli import main
from recon_cli.errors import ConfigError, InputError, ReconError
from recon_cli.experiments import backends
from recon_cli.experiments.backends import SCHEMA, BenchRequest, answer, errors, parse_size, run
from recon_cli.experiments.synthetic_room import SceneSize, build_scene
from recon_cli.progress import NullProgress
from recon_cli.render.torch import tiles

Said = pytest.CaptureFixture[str]
TINY = SceneSize(200, 48, 32)
# The bounds of tests/render in float32; a fragment on the edge of a threshold may flip, which
# costs up to 1/255 of a colour difference at one pixel.
IMAGE_RMS, GRADIENT = 1e-5, 1e-3


@pytest.mark.integration
def test_quick_writes_the_promised_keys_and_the_errors_are_small(
    tmp_path: Path, capsys: Said
) -> None:
    figures = tmp_path / "bench.json"
    words = ["bench", "--quick", "--rounds", "1", "--threads", "1", "--device", "cpu",
             "--gaussians", "300", "--size", "64x48"]
    threads = torch.get_num_threads()
    assert main([*words, "--out", str(figures)]) == 0
    assert torch.get_num_threads() == threads
    out = capsys.readouterr().out
    record = json.loads(figures.read_text())
    assert (record["schema"], record["version"], record["rounds"]) == (SCHEMA, 3, 1)
    assert record["machine"]["versions"]["torch"]
    scene = record["scenes"]["room"]
    assert (scene["gaussians"], scene["width"], scene["sh_degree"]) == (300, 64, 3)
    assert list(scene["backends"]) == ["numba", "torch"]
    for one in scene["backends"].values():
        assert all(one[f"{name}_ms"] > 0 for name in ("forward", "backward", "step"))
        assert one["image_error_rms"] < IMAGE_RMS
        assert one["gradient_relative_error"] < GRADIENT
    rows = [line.split()[0] for line in out.splitlines() if line.startswith(("numba", "torch"))]
    assert rows == ["numba", "torch"]


def test_a_row_has_the_speed_and_the_error_of_a_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    figures = {
        "numba": backends.BackendFigures(10.0, 20.0, 40.0, 10**7, 1e-6, 1e-7, 2e-6),
        "torch": backends.BackendFigures(80.0, 160.0, 300.0, 10**8, math.inf, 1e-7, 2e-6)}
    monkeypatch.setattr(backends, "measure", lambda _plan, _progress: figures)
    result = run(BenchRequest(device="cpu", threads=1), NullProgress())
    assert result.tables[0].rows == [
        ("numba", "30", "8.00x", "40", "10", "1.00e-06", "1.00e-07", "2.00e-06"),
        ("torch", "240", "1.00x", "300", "100", "inf", "1.00e-07", "2.00e-06")]
    assert result.record["scenes"]["room"]["backends"]["torch"]["image_error_max"] is None


@pytest.mark.parametrize(("words", "code", "said"), [
    (["--backend", "cuda"], 6, "'cuda'"),
    (["--size", "640"], 2, "WIDTHxHEIGHT"),
    (["--out", "none/a"], 3, "does not exist"),
    (["--rounds", "0"], 2, "--rounds"),
])
def test_what_cannot_be_done_is_refused_before_anything_is_measured(
    words: list[str], code: int, said: str, tmp_path: Path, capsys: Said,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "recon_cli.experiments.backends.measure", lambda *_: pytest.fail("measured"))
    assert main(["bench", *words]) == code
    err = capsys.readouterr().err
    assert said in err
    assert "hint: " in err


def test_the_room_is_the_same_for_the_same_seed() -> None:
    one, two = build_scene(TINY, 3, "cpu"), build_scene(TINY, 3, "cpu")
    other = build_scene(TINY, 3, "cpu", seed=1)
    assert torch.equal(one.splats.means, two.splats.means)
    assert torch.equal(one.weights, two.weights)
    assert not torch.equal(one.splats.means, other.splats.means)
    assert answer(one, tiles.render)[0].std() > 0.02  # something is to be seen


def test_errors_of_a_known_difference() -> None:
    image = torch.zeros(2, 2, 3, dtype=torch.float64)
    ones = torch.ones(4, dtype=torch.float64)
    truth = image, {"means": ones, "quats": 2 * ones, "sh_rest": 0 * ones}
    assert errors(truth, truth) == (0.0, 0.0, 0.0)
    wrong = image.clone()
    wrong[0, 0, 0] = 0.5
    found = errors((wrong, {"means": ones, "quats": 3 * ones, "sh_rest": ones}), truth)
    assert found == pytest.approx((0.5, (0.25 / 12) ** 0.5, 0.5))


def test_what_is_not_a_number_is_infinitely_wrong() -> None:
    image = torch.zeros(1, 1, 3, dtype=torch.float64)
    ones = torch.ones(4, dtype=torch.float64)
    found = errors((image + torch.nan, {"means": ones * torch.nan, "quats": ones}),
                   (image, {"means": ones, "quats": ones}))
    assert found == (math.inf, math.inf, math.inf)


def request(**changes: object) -> BenchRequest:
    return BenchRequest(device="cpu", threads=1, **changes)


def test_a_size_is_two_numbers_of_parse_size() -> None:
    assert parse_size("640x360") == (640, 360)
    for text in ("640", "0x3", "3x0", "-1x2", "1x2x3", "axb", ""):
        with raises(ConfigError, "WIDTHxHEIGHT"):
            parse_size(text)
    with pytest.raises(ReconError):
        request(size="large")


def test_quick_takes_fewer_rounds_unless_told() -> None:
    assert request().plan().rounds > request(quick=True).plan().rounds
    assert request(quick=True, rounds=5).plan().rounds == 5


def test_an_output_needs_its_folder(tmp_path: Path) -> None:
    with raises(InputError):
        request(out=tmp_path / "none" / "a.json")
