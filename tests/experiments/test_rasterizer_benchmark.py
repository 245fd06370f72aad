"""`recon bench` in process: the errors that it finds are bounded, times are never asserted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from recon_cli.cli import main
from recon_cli.experiments.bench_measure import PASSES
from recon_cli.experiments.bench_scene import (
    Answer,
    SceneSize,
    accuracy,
    build_scene,
    oracle,
)

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
    assert main([*words, "--out", str(figures)]) == 0
    out = capsys.readouterr().out
    record = json.loads(figures.read_text())
    scene = record["scenes"]["room"]
    assert list(scene["backends"]) == ["numba", "torch"]
    for one in scene["backends"].values():
        assert all(one[f"{name}_ms"] > 0 for name in PASSES)
        assert one["image_error_rms"] < IMAGE_RMS
        assert one["gradient_relative_error"] < GRADIENT
    rows = [line.split()[0] for line in out.splitlines() if line.startswith(("numba", "torch"))]
    assert rows == ["numba", "torch"]


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
        "recon_cli.experiments.rasterizer_benchmark.measure", lambda *_: pytest.fail("measured"))
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
    assert oracle(one).image.std() > 0.02  # something is to be seen


def test_accuracy_of_a_known_difference() -> None:
    image = torch.zeros(2, 2, 3, dtype=torch.float64)
    ones = torch.ones(4, dtype=torch.float64)
    truth = Answer(image, {"means": ones, "quats": 2 * ones, "sh_rest": 0 * ones})
    assert accuracy(truth, truth).image_error_max == 0
    wrong = image.clone()
    wrong[0, 0, 0] = 0.5
    found = accuracy(Answer(wrong, {
        "means": ones, "quats": 3 * ones, "sh_rest": ones}), truth)
    assert found.image_error_max == 0.5
    assert found.image_error_rms == pytest.approx((0.25 / 12) ** 0.5)
    assert found.flipped_pixels == 0.25
    assert found.gradient_worst == "quats"
    assert found.gradient_relative_error == pytest.approx(0.5)
    # (1, 1.5) against (1, 1)
    assert found.gradient_cosine == pytest.approx(2.5 / (3.25 * 2) ** 0.5)


def test_what_is_not_a_number_is_infinitely_wrong() -> None:
    image = torch.zeros(1, 1, 3, dtype=torch.float64)
    ones = torch.ones(4, dtype=torch.float64)
    found = accuracy(Answer(image + torch.nan, {"means": ones * torch.nan}),
                     Answer(image, {"means": ones}))
    assert found.image_error_max == found.gradient_relative_error == float("inf")
    assert found.flipped_pixels == 1
    assert found.gradient_cosine == 0
