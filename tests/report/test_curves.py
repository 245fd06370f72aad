"""The prune curve: what is marked, and that a sweep of another training is called stale."""

import json
import os
import re

import pytest
from report_workspace import page_of, section

from recon_cli.workspace.manifest import Manifest


@pytest.fixture
def sweep(workspace):
    """Writes a sweep that was made from the training that is there, or changed."""
    train = Manifest.read(workspace / "train")

    def trial(score, ratio, gaussians, decibels):
        return {"score": score, "ratio": ratio, "gaussians": gaussians, "steps": 9, "seconds": 1.0,
                "removed": None, "recovered": {"psnr_db": decibels, "ssim": 0.9}}

    def write(**changes):
        (workspace / "sweep.json").write_text(json.dumps({
            "of_train": train.digest, "validation_views": 2, "at": "end", "rounds": 3,
            "recovery_steps": 9, "equal_seconds_of": "loo",
            "before": {"psnr_db": 30.0, "ssim": 0.9},
            "trials": [trial("none", None, 100, 30.1), trial("loo", 0.5, 50, 29.0),
                       trial("loo", 0.9, 10, 25.0), trial("random", 0.5, 50, 27.0),
                       trial("none", 0.5, 100, 30.0)], **changes}))
        return workspace

    return write


def test_the_curve_has_every_score_the_control_and_both_models_marked(sweep):
    pruning = section(page_of(sweep()), "pruning")
    for label in ("loo", "random", "no prune, as many steps", "original model", "compact model"):
        assert f"</svg>{label}</li>" in pruning
    assert "<figcaption>PSNR on 2 validation views after 9 steps of recovery" in pruning
    assert "loo: Gaussians left 10, PSNR, dB 25</title>" in pruning
    assert "megabytes of the .ply" in pruning
    assert "stale" not in pruning


def test_megabytes_are_those_of_the_ply(sweep):
    workspace = sweep()
    pruning = section(page_of(workspace), "pruning")
    train = Manifest.read(workspace / "train").run.summary
    megabytes = (workspace / "train" / "splats.ply").stat().st_size / 1e6
    each = megabytes / train["gaussians"]
    ticks = re.findall(r'x="([\d.]+)" y="(37|273)" text-anchor="middle">([\d.]+)<', pruning)
    above = sorted((float(x), float(value)) for x, y, value in ticks if y == "37")
    below = sorted((float(x), float(value)) for x, y, value in ticks if y == "273")
    slopes = [(row[-1][1] - row[0][1]) / (row[-1][0] - row[0][0]) for row in (above, below)]
    assert slopes[0] / slopes[1] == pytest.approx(each, rel=0.01)


def test_a_sweep_of_another_training_is_stale(sweep):
    pruning = section(page_of(sweep(of_train="0" * 64)), "pruning")
    assert "<strong>The sweep is stale</strong>: it started from another training." in pruning
    assert "recon prune --sweep -w" in pruning


def test_a_sweep_that_does_not_say_its_training_goes_by_its_age(sweep):
    workspace = sweep(of_train=None)
    assert "stale" not in section(page_of(workspace), "pruning")
    os.utime(workspace / "sweep.json", (1e9, 1e9))
    assert "it is older than the training" in section(page_of(workspace), "pruning")


def test_a_sweep_of_a_training_that_went_stale_is_stale_with_it(sweep):
    workspace = sweep()
    (workspace / "recon.toml").write_text("[train]\niterations = 7\n")
    assert "the training that it started from is stale" in section(page_of(workspace), "pruning")


@pytest.mark.parametrize("content", ["", "[]", '{"trials": [{}]}', '{"trials": 3}'])
def test_a_sweep_that_cannot_be_read_is_said(workspace, content):
    (workspace / "sweep.json").write_text(content)
    pruning = section(page_of(workspace), "pruning")
    assert "The sweep is not shown: " in pruning


def test_without_a_sweep_the_command_is_named(workspace):
    pruning = section(page_of(workspace), "pruning")
    assert f"Run <code>recon prune --sweep -w {workspace}</code>" in pruning
    assert "Rounds of removal" in pruning
