"""A vignette from training to the scores: it shades renders, is recorded, and is in no .ply."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_stages import CONFIG, run, without

from recon_cli.config.stages import EvaluateConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.evaluation.reference_views import load_held_out_views, render_view
from recon_cli.io.images import read_image, to_uint8
from recon_cli.io.training_scene import load_scene
from recon_cli.render.response import transmission
from recon_cli.splats.ply import read_ply
from recon_cli.stages import evaluate, train
from recon_cli.workspace.summaries import PhotometrySummary


@pytest.mark.integration
def test_evaluation_shades_renders_by_the_vignette_that_training_found(tiny_pruned, tmp_path):
    inputs, out = without(tiny_pruned, "prune"), tmp_path / "train"
    summary = run(train, replace(CONFIG, vignette="on", iterations=60), inputs, out)
    found = PhotometrySummary.read(out)
    assert summary.photometry == found
    assert summary.parts["vignette"] == "on"
    vignette = found.vignettes[0]
    assert vignette.corner < 1
    folders = {**inputs.folders, "train": out}
    run(evaluate, EvaluateConfig(), StageInputs(folders), tmp_path / "evaluate")
    assert "have the vignette" in (tmp_path / "evaluate" / "table.txt").read_text()
    scene = load_scene(folders, validation=0.0)
    view = load_held_out_views(scene, CONFIG.max_size or 600, StageContext())[0]
    plain = render_view(read_ply(out / "splats.ply"), view.camera, CONFIG.sh_degree or 0, "numba")
    shaded = plain.rgb.numpy() * transmission(view.camera, (vignette.a, vignette.b))[..., None]
    shown = read_image(tmp_path / "evaluate" / "renders" / "base" / view.name, 48, 36)
    assert np.abs(shown.astype(int) - to_uint8(shaded)).max() <= 1
