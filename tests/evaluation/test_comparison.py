"""Models of several scenes in one table: means over scenes, and the table as papers print it."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace

import pytest
from facts import assert_facts

from recon_cli.evaluation.comparison import ScoredModel, format_comparison, scene_means
from recon_cli.evaluation.scores import ModelMetrics, Table, ViewScore

OURS, THEIRS = "original (protocol recon)", "3DGS (protocol 3dgs)"


def model(scene: str, kind: str, psnr_db: float, lpips: float | None = None) -> ScoredModel:
    views = tuple(ViewScore(f"{scene}{i}.png", psnr_db + i, psnr_db, 0.8, 0.9, lpips)
                  for i in (-1, 1))
    score = ModelMetrics.from_views(
        views, gaussians=int(1000 * psnr_db), bytes=10, render_ms=1.0, train_seconds=60.0)
    return ScoredModel(scene, "base", f"{scene}, {kind}", score, f"views of {scene}", kind)


@pytest.fixture
def models() -> list[ScoredModel]:
    return [model("room", THEIRS, 30.0, 0.1), model("room", OURS, 33.0, 0.05),
            model("desk", THEIRS, 20.0, 0.3), model("desk", OURS, 22.0, 0.2)]


def test_means_are_over_scenes_and_by_kind(models: list[ScoredModel]) -> None:
    means = scene_means(models)
    assert list(means) == [f"mean of 2 scenes, {kind}" for kind in (THEIRS, OURS)]
    ours = means[f"mean of 2 scenes, {OURS}"]
    assert (ours.psnr_db, ours.gaussians, ours.train_seconds) == (27.5, 27_500, 60.0)
    assert ours.lpips == pytest.approx(0.125)


def test_a_figure_that_one_scene_lacks_has_no_mean(models: list[ScoredModel]) -> None:
    models[1] = model("room", OURS, 33.0)
    means = scene_means(models)
    assert means[f"mean of 2 scenes, {OURS}"].lpips is None
    assert means[f"mean of 2 scenes, {THEIRS}"].lpips == pytest.approx(0.2)


def test_two_runs_of_one_scene_have_no_mean_over_scenes(models: list[ScoredModel]) -> None:
    twice = [*models, replace(models[1], label="room again")]
    assert list(scene_means(twice)) == [f"mean of 2 scenes, {THEIRS}"]
    assert scene_means(models[:2]) == {}
    assert scene_means([replace(one, kind="") for one in models[::2]]) == {}  # files


def test_csv_has_a_row_for_each_mean(models: list[ScoredModel]) -> None:
    rows = list(csv.DictReader(io.StringIO(format_comparison(models, "csv"))))
    last = rows[-1]
    assert (last["model"], last["view"]) == (f"mean of 2 scenes, {OURS}", "mean")
    assert float(last["psnr_db"]) == 27.5
    assert float(last["lpips"]) == pytest.approx(0.125)
    assert len(rows) == 4 * 3 + 2


def test_latex_sets_the_means_apart_and_takes_caption_and_label(models: list[ScoredModel]) -> None:
    lines = format_comparison(
        models, "latex", caption=r"Both at $30{,}000$ steps", label="tab:rooms").splitlines()
    assert lines[:4] == [
        r"\begin{table}", r"\centering", r"\caption{Both at $30{,}000$ steps}",
        r"\label{tab:rooms}"]
    end = lines.index(r"\end{table}")
    assert lines[end - 5] == r"\midrule"
    assert_facts(lines[end - 4], 2, "3DGS", "3dgs", "25.00")
    assert sum(r"\begin{table}" in line for line in lines) == 1  # differences follow without one
    assert "LPIPS" in lines[6]


def test_latex_without_a_caption_is_the_bare_table() -> None:
    table = Table(("a_b", "50%"), (("x", "1"),))
    assert table.latex().startswith(r"\begin{tabular}{lr}")
    assert table.latex(label="t").startswith(r"\begin{table}")
    assert r"\caption" not in table.latex(label="t")


def test_json_holds_the_means(models: list[ScoredModel]) -> None:
    means = json.loads(format_comparison(models, "json"))["means"]
    assert means[f"mean of 2 scenes, {THEIRS}"]["psnr_db"] == 25.0
