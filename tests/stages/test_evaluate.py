"""evaluate on a tiny scene: what is scored against what, and what the tables say."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from facts import assert_facts, raises
from tiny_scene import VIEWS
from tiny_stages import CONFIG, holding_out, mean_colour_psnr, run, without

from recon_cli.config.stages import EvaluateConfig
from recon_cli.context import StageInputs
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.evaluation import reference_views
from recon_cli.evaluation.metrics import psnr, ssim
from recon_cli.io.images import read_image, write_png
from recon_cli.io.training_scene import load_scene
from recon_cli.splats.ply import read_ply
from recon_cli.stages import evaluate
from recon_cli.trust.records import TrustRecord
from recon_cli.trust.scene_trust import Trust, digest_of
from recon_cli.workspace.records import ImportRecord


@pytest.fixture
def inputs(tiny_pruned):
    """ingest, sfm, and a finished train and prune."""
    return tiny_pruned


@pytest.mark.integration
def test_evaluation_scores_exactly_what_it_wrote(inputs, tmp_path):
    out = tmp_path / "out"
    run(evaluate, EvaluateConfig(), inputs, out)
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["models"]) == {"base", "pruned"}
    for name, model in metrics["models"].items():
        assert set(model) >= {"psnr_db", "ssim", "gaussians", "bytes", "render_ms",
                              "train_seconds", "views"}
        assert [view["name"] for view in model["views"]] == [
            f"{i:06d}.png" for i in range(0, VIEWS, 4)]
        for view in model["views"]:
            shown = read_image(out / "renders" / name / view["name"], 48, 36)
            truth = read_image(out / "truth" / view["name"], 48, 36)
            original = inputs.folders["place"] / "undistorted" / "images" / view["name"]
            assert np.array_equal(truth, read_image(original, 48, 36))
            image = (shown / 255.0).astype(np.float32)
            assert view["psnr_8bit_db"] == pytest.approx(psnr(image, truth), abs=1e-5)
            # the saved render is rounded to 8 bits, the other scores are not
            assert view["psnr_db"] == pytest.approx(psnr(image, truth), abs=0.15)
            assert view["ssim"] == pytest.approx(ssim(image, truth), abs=0.01)
            assert view["ssim_padded"] == pytest.approx(ssim(image, truth, padded=True), abs=0.01)
        assert model["psnr_db"] == pytest.approx(
            np.mean([view["psnr_db"] for view in model["views"]]))
        assert model["bytes"] == (
            inputs.folders["train" if name == "base" else "prune"] / "splats.ply").stat().st_size
    assert metrics["models"]["base"]["psnr_db"] > mean_colour_psnr(inputs) + 2
    table = (out / "table.txt").read_text()
    assert "3DGS" not in table + (out / "metrics.tex").read_text()  # budget is another recipe
    assert [line.split()[0] for line in table.splitlines()[2:4]] == ["original", "compact"]
    assert "scikit-image" not in table, "what scores mean is told by --explain and the report"
    assert "scikit-image" in (out / "metrics.md").read_text()
    assert_facts(table, "LPIPS", "not", "measured")  # no test has its weights
    assert_facts(table, f"{metrics['models']['base']['psnr_db']:.2f}", "dB", "held")
    gained = [pruned["psnr_db"] - base["psnr_db"] for base, pruned in zip(
        *(metrics["models"][name]["views"] for name in ("base", "pruned")), strict=True)]
    assert metrics["pruned_minus_base"]["psnr_db"]["mean"] == pytest.approx(np.mean(gained))
    assert min(gained) <= metrics["pruned_minus_base"]["psnr_db"]["low"] <= np.mean(gained)
    assert "data set & PSNR original & PSNR compact" in (out / "metrics.tex").read_text()
    assert len((out / "metrics.csv").read_text().splitlines()) == 1 + 2 * (VIEWS // 4 + 1)


def test_views_that_training_saw_are_scored_beside_the_held_out_ones(inputs, tmp_path):
    run(evaluate, EvaluateConfig(), without(inputs, "prune"), tmp_path / "out")
    model = json.loads((tmp_path / "out" / "metrics.json").read_text())["models"]["base"]
    log = (inputs.folders["train"] / "log.jsonl").read_text().splitlines()
    assert model["seen_psnr_db"]["validation"] == pytest.approx(
        json.loads(log[-1])["validation_psnr_db"], abs=1e-3)
    assert model["seen_psnr_db"]["training"] > model["psnr_db"]


@pytest.mark.integration
def test_scores_are_against_the_original_pixels_also_where_training_saw_denoised_ones(
    inputs, tmp_path
):
    folder = tmp_path / "place"
    shutil.copytree(inputs.folders["place"], folder)
    for path in (folder / "undistorted" / "denoised").iterdir():
        path.write_bytes((folder / "undistorted" / "denoised" / "000001.png").read_bytes())
    changed = StageInputs({**inputs.folders, "place": folder})
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "a")
    run(evaluate, EvaluateConfig(), changed, tmp_path / "b")
    first, second = (json.loads((tmp_path / name / "metrics.json").read_text())["models"]["base"]
                     for name in "ab")
    assert first["psnr_db"] == second["psnr_db"]


def test_without_pruning_there_is_one_model(inputs, tmp_path):
    run(evaluate, EvaluateConfig(), without(inputs, "prune"), tmp_path / "out")
    assert set(json.loads((tmp_path / "out" / "metrics.json").read_text())["models"]) == {"base"}


def test_a_held_out_frame_without_a_camera_is_named(inputs, tmp_path, caplog):
    folder = tmp_path / "ingest"
    shutil.copytree(inputs.folders["ingest"], folder)
    frames = json.loads((folder / "frames.json").read_text())
    frames["frames"].append({**frames["frames"][0], "name": "999999.png"})
    (folder / "frames.json").write_text(json.dumps(frames))
    summary = run(evaluate, EvaluateConfig(), StageInputs({**inputs.folders, "ingest": folder}),
                  tmp_path / "out")
    assert summary.unregistered_test == ("999999.png",)
    assert "999999.png" in caplog.text


def test_frames_that_sfm_left_out_are_counted_and_placed(inputs, tmp_path):
    folder = tmp_path / "ingest"
    shutil.copytree(inputs.folders["ingest"], folder)
    frames = json.loads((folder / "frames.json").read_text())
    added = [f"99999{i}.png" for i in range(3)]
    frames["frames"] += [
        {**frames["frames"][0], "name": name, "time_seconds": 20 + i, "held_out": i == 2}
        for i, name in enumerate(added)]
    (folder / "frames.json").write_text(json.dumps(frames))
    run(evaluate, EvaluateConfig(), StageInputs({**inputs.folders, "ingest": folder}),
        tmp_path / "out")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    train = VIEWS - VIEWS // 4 - 1  # one is for validation
    assert (metrics["frames"], metrics["training_views"]) == (VIEWS + 3, train)
    assert metrics["unregistered"] == added
    line = (f"trained on {train} of {VIEWS + 3} frames; 3 frames left out, as they have no camera "
            "in this model, 1 of them held out and so not scored: "
            "999990.png to 999992.png (20.0 to 22.0 s)\n")
    for name in ("table.txt", "metrics.md"):
        assert line in (tmp_path / "out" / name).read_text()


def test_where_every_frame_has_a_camera_nothing_is_said_to_be_left_out(inputs, tmp_path):
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["unregistered"] == []
    assert "left out" not in (tmp_path / "out" / "table.txt").read_text()


def test_views_too_small_to_score_are_a_usage_error(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(reference_views, "MIN_SIDE", 13)  # 16 pixels wide are 12 high here
    with raises(ConfigError, "16x12") as caught:
        run(evaluate, EvaluateConfig(max_size=16), inputs, tmp_path / "out")
    assert "--max-size" in caught.value.hint


def test_nothing_to_score_on_is_an_error(inputs, tmp_path):
    with raises(ReconstructionError, "held-out", "view"):
        run(evaluate, EvaluateConfig(), holding_out(inputs, tmp_path, held_out=False),
            tmp_path / "out")


def test_trust_is_measured_checked_on_held_out_views_and_drawn(inputs, tmp_path):
    out = tmp_path / "out"
    summary = run(evaluate, EvaluateConfig(), inputs, out)
    record = TrustRecord.read(out)
    assert record.models == ("pruned",)  # what export takes
    trust = record.pruned
    assert trust.agreement.views == VIEWS // 4
    assert trust.agreement.ause < trust.agreement.ause_depth
    assert trust.error.calibrated
    assert trust.views == len(load_scene(inputs.folders, validation=CONFIG.validation).train)
    assert sorted(path.name for path in (out / "trust" / "pruned").iterdir()) == [
        f"{i:06d}.png" for i in range(0, VIEWS, 4)]
    splats = read_ply(inputs.folders["prune"] / "splats.ply")
    assert Trust.load(out, "pruned", digest_of(splats), 0).support.count.shape == (len(splats),)
    assert Trust.load(out, "base", digest_of(splats), 0) is None  # of other Gaussians
    assert len(summary.poorly_seen) == len(record.poorly_seen)
    assert all("poorly" in line for line in summary.poorly_seen)


@pytest.mark.integration
def test_trust_renders_no_view_again_that_scoring_rendered(inputs, tmp_path, monkeypatch):
    drawn = []
    render_view = reference_views.render_view

    def count(splats, camera, *arguments):
        drawn.append((len(splats), reference_views._key(camera)))
        return render_view(splats, camera, *arguments)

    monkeypatch.setattr(reference_views, "render_view", count)
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "a")
    assert len(drawn) == len(set(drawn))
    monkeypatch.setattr(evaluate, "_ROOM", 0)
    drawn.clear()
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "b")
    assert len(drawn) > len(set(drawn))
    for path in sorted((tmp_path / "a" / "trust").rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (
                tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()


def test_held_out_views_calibrate_nothing(inputs, tmp_path):
    changed = tmp_path / "place"
    shutil.copytree(inputs.folders["place"], changed)
    for i in range(0, VIEWS, 4):
        path = changed / "undistorted" / "images" / f"{i:06d}.png"
        write_png(path, 255 - read_image(path, 48, 36))
    records = []
    for number, sfm in enumerate((inputs.folders["place"], changed)):
        given = without(StageInputs({**inputs.folders, "place": sfm}), "prune")
        run(evaluate, EvaluateConfig(), given, tmp_path / f"out{number}")
        records.append(TrustRecord.read(tmp_path / f"out{number}"))
    assert records[0].base.error == records[1].base.error
    assert records[0].base.agreement != records[1].base.agreement


def test_without_trust_nothing_of_it_is_written(inputs, tmp_path):
    summary = run(evaluate, EvaluateConfig(trust=False), without(inputs, "prune"), tmp_path / "out")
    assert summary.poorly_seen is None
    assert not (tmp_path / "out" / "trust").exists()
    assert TrustRecord.read(tmp_path / "out") is None


def test_a_scene_whose_views_do_not_fit_has_no_trust_and_says_why(inputs, tmp_path):
    folder = tmp_path / "train"
    shutil.copytree(inputs.folders["train"], folder)
    ImportRecord("room.ply", "ply", "0", 1, 0, z_up=True, views=True,
                 doubt="it may not be in the frame of the views").write(folder)
    given = without(StageInputs({**inputs.folders, "train": folder}), "prune")
    run(evaluate, EvaluateConfig(), given, tmp_path / "out")
    record = TrustRecord.read(tmp_path / "out")
    assert record.models == ()
    assert_facts(record.reason, "frame")
    assert record.lines() == []
