"""Scores of models in closed form, and the tables that hold them."""

import csv
from dataclasses import replace

import pytest

from recon_cli.config.stages import RunConfig
from recon_cli.evaluation.scores import (
    REFERENCE,
    Metrics,
    ModelMetrics,
    Table,
    ViewScore,
    csv_table,
    model_table,
    paper_table,
    view_table,
)


def view(name, psnr_db, ssim, lpips=None):
    return ViewScore(name, psnr_db, psnr_db - 0.01, ssim, ssim + 0.01, lpips)


def scores():
    views = (view("a.png", 30.0, 0.9), view("b.png", 32.0, 0.8))
    return {"3DGS": ModelMetrics.from_views(views, gaussians=1234, bytes=5_000_000, render_ms=12.0,
                                    train_seconds=60.0),
            "ours": ModelMetrics.from_views(views, gaussians=600, bytes=2_000_000, render_ms=6.0)}


def test_means_are_over_views():
    assert scores()["3DGS"].psnr_db == 31.0
    assert scores()["3DGS"].psnr_8bit_db == 30.99
    assert scores()["3DGS"].ssim == pytest.approx(0.85)
    assert scores()["3DGS"].ssim_padded == pytest.approx(0.86)


def test_lpips_has_no_mean_where_a_view_has_none():
    half, whole = (
        ModelMetrics.from_views(
            (view("a", 30, 0.9, 0.1), view("b", 30, 0.9, lpips)), gaussians=1, bytes=1,
            render_ms=1) for lpips in (None, 0.3))
    assert half.lpips is None
    assert whole.lpips == pytest.approx(0.2)
    assert "LPIPS" in model_table({"x": half, "y": whole}).headings
    assert "LPIPS" not in model_table({"x": half}).headings


def test_the_gain_has_a_column_where_it_was_measured_and_a_gap_of_its_own():
    views = tuple(replace(view("a.png", psnr, 0.9), gain_psnr_db=psnr + 2) for psnr in (30.0, 32.0))
    common = {"gaussians": 1, "bytes": 1, "render_ms": 1}
    plain = ModelMetrics.from_views(views, **common)
    gained = ModelMetrics.from_views(views, seen_after_gains=True, **common)
    assert plain.gain_psnr_db == 33.0
    table = model_table({"x": plain})
    assert table.rows[0][table.headings.index("after gain")] == "33.00"
    assert "after gain" not in model_table(scores()).headings, "of an older version"
    assert (plain.gap_psnr_db, gained.gap_psnr_db) == (31.0, 33.0)
    older = ModelMetrics.from_json({
        key: value for key, value in gained.to_json().items() if key != "seen_after_gains"})
    assert older.gap_psnr_db == 33.0, "which had it only with --exposure"


def test_every_table_holds_the_same_figures():
    table = model_table(scores())
    assert table.rows[0] == (
        "3DGS", "31.00", "30.99", "0.8500", "0.8600", "1,234", "5.0", "12", "60")
    assert table.rows[1][-1] == "-"
    assert view_table(scores()).rows[0] == (
        "a.png", "30.00", "30.00", "0.9000", "0.9000")
    rows = list(csv.DictReader(csv_table(scores()).splitlines()))
    assert [row["view"] for row in rows] == ["a.png", "b.png", "mean"] * 2
    assert float(rows[2]["psnr_db"]) == 31.0
    assert float(rows[2]["ssim_padded"]) == pytest.approx(0.86)
    assert rows[0]["lpips"] == ""


def test_the_table_of_the_paper_sets_two_models_side_by_side_by_data_set():
    base, pruned = scores().values()
    table = paper_table({"room0": (base, pruned)}, ("3DGS", "pruned"))
    assert table.headings == ("data set", "PSNR 3DGS", "PSNR pruned", "SSIM 3DGS", "SSIM pruned")
    assert table.rows == (("room0", "31.00", "31.00", "0.8500", "0.8500"),)


@pytest.mark.parametrize(("changes", "expected"), [
    ({}, True),
    ({"iterations": 30_000, "images": "denoised", "seed": 4}, True),
    ({"densify": "budget"}, False),
    ({"background": "on"}, False),
    ({"ssim_weight": 0.0}, False),
    ({"sh_degree": 1}, False),
])
def test_only_the_recipe_of_3dgs_is_the_reference(changes, expected):
    plain = {"densify": "reference", "background": "off", "stereo": "off", "exposure": "off"}
    assert RunConfig(**{**plain, **changes}).is_reference is expected


def metrics_of(**more):
    return Metrics(
        models=dict(zip(("base", "pruned"), scores().values(), strict=True)), psnr_convention="",
        psnr_8bit_convention="", ssim_convention="", ssim_padded_convention="",
        lpips_convention="", truth_digest="", width=1, height=1, test_views=2,
        unregistered_test=(), **more)


@pytest.mark.parametrize(("recipe", "labels"), [
    (REFERENCE, ["3DGS", "compact"]), (None, ["original", "compact"])])
def test_tables_name_a_base_model_3dgs_only_where_it_was_trained_so(recipe, labels):
    metrics = metrics_of(base_recipe=recipe)
    assert [metrics.label(name) for name in metrics.models] == labels
    assert Metrics.from_json(metrics.to_json()).base_recipe == recipe


def test_tables_name_the_protocol_that_was_followed():
    metrics = metrics_of(base_recipe=REFERENCE, protocol="3dgs")
    assert [metrics.label(name) for name in metrics.models] == [
        "3DGS (protocol 3dgs)", "compact (protocol 3dgs)"]
    record = metrics.to_json()
    assert Metrics.from_json(record).protocol == "3dgs"
    del record["protocol"]  # as before there were protocols
    assert Metrics.from_json(record).protocol is None


def test_a_table_says_the_same_in_every_form():
    table = Table(("a_b", "50%"), (("x", "1"), ("yy", "22")))
    assert table.text() == "a_b  50%\nx      1\nyy    22"
    assert table.text(rule=True).splitlines()[1] == "-" * 8
    assert table.markdown() == "| a_b | 50% |\n| --- | ---: |\n| x | 1 |\n| yy | 22 |\n"
    assert table.latex() == (
        "\\begin{tabular}{lr}\n\\toprule\na\\_b & 50\\% \\\\\n\\midrule\nx & 1 \\\\\n"
        "yy & 22 \\\\\n\\bottomrule\n\\end{tabular}\n")
