"""Tables, words, JSON and the picture of the study: pure functions of known figures."""

import json

import pytest
from facts import assert_facts

from recon_cli.config.stages import RunConfig
from recon_cli.experiments import study
from recon_cli.experiments.clock import Host
from recon_cli.experiments.paper_tables import TABLE_I, published_scores
from recon_cli.experiments.runner import CurvePoint, Record, SceneRuns
from recon_cli.experiments.study import (
    COMPARISONS,
    EQUAL_SECONDS,
    EQUAL_STEPS,
    MEAN,
    PAIRS,
    PAPER_TABLES,
    VARIANTS,
    StudyResult,
)

pytestmark = pytest.mark.floors

HOST = Host("A CPU", 2, 2, 16, "cpu", {"torch": "2", "numpy": "2", "python": "3"})
NOISE = (0.0, 0.3, -0.3)  # of the seeds, the same for all arms


def scene(base_db, gains, machine="A CPU"):
    """Figures that are known: 3DGS has base_db and each variant its gain; seed noise is common.

    The last variant has noise of its own, so that its interval is wide.
    """
    runs = {}
    for comparison in COMPARISONS:
        runs[comparison] = {}
        for variant, gain in zip(VARIANTS, gains, strict=True):
            own = (0.5, -0.5, 0.0) if variant is VARIANTS[-1] else (0.0, 0.0, 0.0)
            runs[comparison][variant.name] = tuple(
                Record((CurvePoint(100, 10.0, 20.0, 5000, 1_240_000, base_db + gain + noise + extra,
                             (base_db + gain + noise + extra) / 50),), machine,
                       "original images" + (", far" if variant in VARIANTS[2:] else ""))
                for noise, extra in zip(NOISE, own, strict=True))
    return SceneRuns(4, 600, 340, runs)


def result(**scenes):
    scenes = scenes or {
        "office0": scene(30.0, (0.0, 0.5, 1.0, 0.1)), "home": scene(20.0, (0.0, -0.1, 1.0, 0.1))}
    return StudyResult(HOST, 3, RunConfig(), "wall", scenes, dict.fromkeys(scenes, "digest"))


def rows(table):
    return {row[0]: row[1:] for row in table.rows}


def notes(result):
    return "\n".join(study.notes(result))


def test_every_scene_and_the_mean_has_a_row_for_each_arm():
    table = rows(study.scores(result(), EQUAL_STEPS))
    assert list(table) == [f"{row}, {variant.label}"
                           for row in ("office0", "home", MEAN) for variant in VARIANTS]
    assert table["office0, 3DGS"] == (
        "30.00", "0.30", "0.6000", "0.0060", "100", "5,000", "1.2", "10.0", "20.0")
    assert table[f"{MEAN}, paper"][0] == "25.20"


def test_a_single_scene_has_no_mean_of_scenes():
    assert not any(MEAN in row for row in rows(study.scores(
        result(home=scene(20.0, (0.0, 1.0, 1.0, 1.0))), EQUAL_STEPS)))


def test_every_pair_has_its_interval():
    table = rows(study.differences(result(), EQUAL_SECONDS))
    assert len(table) == 3 * len(PAIRS) == 15
    assert table["office0, paper - 3DGS"][:3] == ("+0.50", "+0.50", "+0.50")
    assert table["home, paper - 3DGS"][:3] == ("-0.10", "-0.10", "-0.10")
    # noise 0.5, -0.5, 0 around 0.1: half width 4.3027 x 0.5 / sqrt 3
    assert table["home, ours pruned - 3DGS"][:3] == ("+0.10", "-1.14", "+1.34")
    assert table[f"{MEAN}, paper - 3DGS"][:3] == ("+0.20", "+0.20", "+0.20")
    assert table["home, paper - ours"][0] == "-1.10"


def test_the_words_say_whether_an_interval_contains_zero():
    table, text = rows(study.differences(result(), EQUAL_STEPS)), notes(result())
    assert table[f"{MEAN}, paper - 3DGS"][:4] == ("+0.20", "+0.20", "+0.20", "higher")
    assert table[f"{MEAN}, ours pruned - ours"][:4] == (
        "-0.90", "-2.14", "+0.34", "no difference shown")
    assert_facts(text, 3, "seeds")
    assert "machines" not in text
    assert_facts(text, "home:", "3DGS", "paper", "far", "ours pruned")
    one = StudyResult(HOST, 1, RunConfig(), "wall", {"home": SceneRuns(1, 9, 9, {
        name: {variant: records[:1] for variant, records in arms.items()}
        for name, arms in scene(20.0, (0.0, 1.0, 1.0, 1.0)).runs.items()})}, {})
    assert rows(study.differences(one, EQUAL_STEPS))["home, paper - 3DGS"][1:4] == (
        "-", "-", "one seed")


def test_runs_of_two_machines_are_told():
    mixed = result(home=scene(20.0, (0, 0, 0, 0)), office=scene(20.0, (0, 0, 0, 0), "Another"))
    assert mixed.machines == ("A CPU", "Another")
    assert_facts(notes(mixed), "machines")


def test_the_figures_of_the_paper_stand_beside_scenes_of_their_names():
    assert len(TABLE_I) == 8
    assert published_scores("Office0") is TABLE_I["office0"]
    assert published_scores("office") is None
    table = study.beside_the_paper(result())
    assert rows(table) == {"office0": (
        "38.45", "0.925", "39.05", "0.934", "+0.60", "+0.009",
        "30.00", "0.600", "30.50", "0.610", "+0.50", "+0.010")}
    assert study.beside_the_paper(result(home=scene(20.0, (0, 0, 0, 0)))) is None
    assert_facts(notes(result()), "measure", "thing")


def test_the_record_holds_every_seed_and_is_json():
    record = json.loads(json.dumps(result().record(), allow_nan=False))
    assert (record["schema"], record["version"]) == ("recon-study", 1)
    home = record["comparisons"][EQUAL_STEPS]["home"]
    assert home["arms"]["reference"]["psnr_db"]["by_seed"] == pytest.approx([20.0, 20.3, 19.7])
    assert home["differences"]["paper - reference"]["psnr_db"]["shown"] == "lower"
    assert record["arms"][1]["prune"]["ratio"] == 0.6
    assert record["scenes"]["home"] == {
        "views": 4, "width": 600, "height": 340, "digest": "digest",
        "parts": {"reference": "original images", "paper": "original images",
                  "budget": "original images, far", "budget-pruned": "original images, far"}}


def test_the_picture_is_drawn(tmp_path):
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    study.draw(result(), tmp_path / "study.svg")
    assert (tmp_path / "study.svg").stat().st_size > 5000
    assert list(tmp_path.iterdir()) == [tmp_path / "study.svg"]


def test_the_tables_of_the_paper_are_whole_whatever_was_run():
    def equal_steps(db):
        arms = scene(db, (0.0, -0.5, 1.0, 0.0)).runs[EQUAL_STEPS]
        return {EQUAL_STEPS: {arm.name: arms[arm.name] for arm in PAPER_TABLES.variants}}

    runs = {"Room0": equal_steps(30.0), "home": equal_steps(20.0)}
    scenes = {name: SceneRuns(4, 600, 340, comparisons) for name, comparisons in runs.items()}
    studied = StudyResult(HOST, 3, RunConfig(), "wall", scenes, dict.fromkeys(scenes, "digest"),
                          PAPER_TABLES)
    first, second = study.paper_tables(studied)
    assert [row[0] for row in first.rows] == [*TABLE_I, "mean of 8", "mean of 1 run"]
    assert rows(first)["room0"] == (
        "37.26", "0.915", "38.06", "0.923", "30.00", "0.600", "29.50", "0.590", "31.00", "0.620")
    assert rows(first)["room1"][:4] == ("36.28", "0.929", "37.75", "0.935")
    assert set(rows(first)["room1"][4:]) == {"-"}
    assert rows(first)["mean of 8"][:4] == ("36.59", "0.931", "37.11", "0.942")
    assert rows(first)["mean of 1 run"] == rows(first)["room0"]
    assert first.means == 2
    assert rows(second)["home"][4:] == ("20.00", "0.400", "19.50", "0.390", "21.00", "0.420")
    assert rows(second)["the paper's capture"][:4] == ("30.41", "0.879", "31.89", "0.897")
    assert study.tables(studied)[:2] == [first, second]
    assert "Equal seconds" not in notes(studied)
    assert_facts(notes(studied), "measure", "thing")
    json.dumps(studied.record(), allow_nan=False)
