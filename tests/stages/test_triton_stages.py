"""train, prune and evaluate on the triton backend: all stages, and going on after a stop.

Where there is no GPU a step takes seconds in triton's interpreter.
"""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from interpreter import DEVICE
from tiny_scene import make_inputs
from tiny_stages import CONTEXT, mean_colour_psnr, run

from recon_cli.config.stages import EvaluateConfig, PruneConfig, RunConfig
from recon_cli.context import StageInputs
from recon_cli.io.ply import read_ply
from recon_cli.stages import evaluate, prune, train
from recon_cli.train import runner
from recon_cli.train.state import save_state

pytest.importorskip("triton", reason="triton is not installed")
pytestmark = pytest.mark.slow

ON_TRITON = replace(CONTEXT, backend="triton", device=DEVICE)
CONFIG = RunConfig(
    iterations=8, densify_every=4, max_gaussians=80, sh_degree=0, far="off", exposure="off",
    poses="off", images="original", checkpoint_every=3, early_stop=False)
FILES = ("splats.ply", "mid.safetensors", "final.safetensors")


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill: nothing gets the chance to clean up."""


def test_every_stage_runs_and_a_killed_training_ends_with_the_same_bytes(tmp_path, monkeypatch):
    inputs = make_inputs(tmp_path)
    run(train, CONFIG, inputs, tmp_path / "train", ON_TRITON)

    def save_then_die(path, state):
        save_state(path, state)
        raise Killed

    # the same plan, whatever the clock says
    (tmp_path / "again").mkdir()
    for name in ("plan.json", "config.json"):
        (tmp_path / "again" / name).write_bytes((tmp_path / "train" / name).read_bytes())
    with monkeypatch.context() as patch:
        patch.setattr(runner, "save_state", save_then_die)
        with pytest.raises(Killed):
            run(train, CONFIG, inputs, tmp_path / "again", ON_TRITON)
    assert (tmp_path / "again" / runner.CHECKPOINT).exists()
    run(train, CONFIG, inputs, tmp_path / "again", ON_TRITON)
    for name in FILES:
        ours, theirs = (tmp_path / folder / name for folder in ("train", "again"))
        assert ours.read_bytes() == theirs.read_bytes(), name

    inputs = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    summary = run(
        prune, PruneConfig(ratio=0.5, at="mid", rounds=1), inputs, tmp_path / "prune", ON_TRITON)
    left = len(read_ply(tmp_path / "prune" / "splats.ply"))
    assert left == summary.gaussians == -(-summary.gaussians_before // 2)
    inputs = StageInputs({**inputs.folders, "prune": tmp_path / "prune"})
    run(evaluate, EvaluateConfig(), inputs, tmp_path / "evaluate", ON_TRITON)
    models = json.loads((tmp_path / "evaluate" / "metrics.json").read_text())["models"]
    assert models["base"]["psnr_db"] > mean_colour_psnr(inputs)
    assert models["pruned"]["psnr_db"] > mean_colour_psnr(inputs) - 1
