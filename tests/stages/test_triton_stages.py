"""train, prune and evaluate on the triton backend: all stages, and resuming after a stop.

Without a GPU a step takes seconds in triton's interpreter.
"""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from interpreter import DEVICE
from tiny_scene import Shape, make_inputs
from tiny_stages import CONTEXT, run

from recon_cli.config.stages import EvaluateConfig, PruneConfig, RunConfig
from recon_cli.context import StageInputs
from recon_cli.splats.ply import read_ply
from recon_cli.stages import evaluate, prune, train
from recon_cli.train.fit import runner
from recon_cli.train.fit.state import save_state

pytest.importorskip("triton", reason="triton is not installed")
pytestmark = pytest.mark.slow

ON_TRITON = replace(CONTEXT, backend="triton", device=DEVICE)
CONFIG = RunConfig(
    iterations=8, densify_every=4, max_gaussians=80, sh_degree=0, background="off", exposure="off",
    images="original", checkpoint_every=3, early_stop=False)
SMALL = Shape(22, 18, 18.0)  # four tiles
VIEWS = 6  # two of them held out
FILES = ("splats.ply", "mid.safetensors", "final.safetensors")


class Killed(Exception):  # noqa: N818 - an event, not an error
    """Stands for a kill: nothing gets the chance to clean up."""


def test_every_stage_runs_and_a_killed_training_ends_with_the_same_bytes(tmp_path, monkeypatch):
    inputs = make_inputs(tmp_path, (SMALL,), VIEWS)
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

    ours = pruned_and_scored(inputs, tmp_path, "", ON_TRITON)
    on_torch = replace(CONTEXT, backend="torch")
    run(train, CONFIG, inputs, tmp_path / "torch-train", on_torch)
    theirs = pruned_and_scored(inputs, tmp_path, "torch-", on_torch)
    # so few steps come to nothing by themselves
    assert ours["base"]["psnr_db"] == pytest.approx(theirs["base"]["psnr_db"], abs=0.05)
    assert ours["pruned"]["psnr_db"] == pytest.approx(theirs["pruned"]["psnr_db"], abs=0.5)


def pruned_and_scored(inputs, folder, prefix, context):
    """The scores of the model in the folder that `prefix` begins, and of half of it."""
    inputs = StageInputs({**inputs.folders, "train": folder / f"{prefix}train"})
    out = folder / f"{prefix}prune"
    summary = run(prune, PruneConfig(ratio=0.5, at="mid", rounds=1), inputs, out, context)
    assert len(read_ply(out / "splats.ply")) == summary.gaussians == -(
        -summary.gaussians_before // 2)
    inputs = StageInputs({**inputs.folders, "prune": out})
    scores = folder / f"{prefix}evaluate"
    run(evaluate, EvaluateConfig(), inputs, scores, context)
    return json.loads((scores / "metrics.json").read_text())["models"]
