"""Stages on scenes of a low SH degree, and of Gaussians that are not all of one."""

import json

import pytest
import torch
from facts import raises
from safetensors.torch import load_file
from scenes import random_splats, with_harmonics
from tiny_scene import make_inputs
from tiny_stages import run_export

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import EvaluateConfig, PruneConfig, RunConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import WorkspaceError
from recon_cli.export import verify
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.stages import evaluate, export, prune, train
from recon_cli.train.fit import runner
from recon_cli.train.fit.state import save_state
from recon_cli.train.fit.train_data import write_config

CONTEXT = StageContext(backend="numba")


def config_of(degree):
    return TrainConfig(
        iterations=60, densify_every=10, densify_gradient=1e-5, max_gaussians=90, sh_rate=0.05,
        sh_degree=degree, checkpoint_every=7)


@pytest.fixture(scope="module", params=[0, 1])
def trained(request, tmp_path_factory):
    """A degree, and the inputs with a training of that degree."""
    folder = tmp_path_factory.mktemp("low")
    given = make_inputs(folder)
    (folder / "train").mkdir()
    train.run(config_of(request.param), given, folder / "train", CONTEXT)
    return request.param, StageInputs({**given.folders, "train": folder / "train"})


@pytest.mark.integration
def test_a_low_degree_is_stored_from_the_first_step_to_the_file(trained):
    degree, inputs = trained
    terms = (degree + 1) ** 2 - 1
    for name in ("mid", "final"):
        state = load_file(inputs.folders["train"] / f"{name}.safetensors")
        assert state["splats.sh_rest"].shape[1:] == (terms, 3)
        assert state["adam.sh_rest.exp_avg_sq"].shape[1:] == (terms, 3)
    path = inputs.folders["train"] / "splats.ply"
    assert path.read_bytes().count(b"property float f_rest_") == 3 * terms
    assert read_ply(path).sh_degree == degree


@pytest.mark.integration
def test_a_killed_training_of_a_low_degree_ends_with_the_same_bytes(
    trained, tmp_path, monkeypatch
):
    degree, inputs = trained

    class Killed(Exception):  # noqa: N818 - an event, not an error
        pass

    def save_then_die(path, state):
        save_state(path, state)
        if state.iteration >= 28:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(runner, "save_state", save_then_die)
        with pytest.raises(Killed):
            train.run(config_of(degree), inputs, tmp_path, CONTEXT)
    train.run(config_of(degree), inputs, tmp_path, CONTEXT)
    for name in ("splats.ply", "final.safetensors"):
        assert (tmp_path / name).read_bytes() == (
            inputs.folders["train"] / name).read_bytes(), name


def test_pruning_evaluating_and_exporting_keep_the_degree(trained, tmp_path):
    degree, inputs = trained
    (tmp_path / "prune").mkdir()
    prune.run(PruneConfig(ratio=0.5, at="mid"), inputs, tmp_path / "prune", CONTEXT)
    both = StageInputs({**inputs.folders, "prune": tmp_path / "prune"})
    for name, stage, config in (("evaluate", evaluate, EvaluateConfig()),
                                ("export", export, ExportConfig())):
        (tmp_path / name).mkdir()
        stage.run(config, both, tmp_path / name, CONTEXT)
    assert read_ply(tmp_path / "export" / "splats.ply").sh_degree == degree
    models = json.loads((tmp_path / "evaluate" / "metrics.json").read_text())["models"]
    assert models["base"]["psnr_db"] > 0
    assert models["pruned"]["gaussians"] < models["base"]["gaussians"]


@pytest.mark.parametrize(("degree", "colored"), [(0, 30), (2, 0), (2, 13), (3, 30)])
def test_an_export_of_any_degree_and_share_is_read_back(tmp_path, degree, colored):
    splats = with_harmonics(random_splats(30, dtype=torch.float32), degree, colored)
    splats.sh_rest[colored // 2:] = 0  # trained to nothing: read back as no rows
    inputs = make_inputs(tmp_path)
    (tmp_path / "train").mkdir()
    (tmp_path / "out").mkdir()
    write_ply(tmp_path / "train" / "splats.ply", splats)
    write_config(tmp_path / "train", RunConfig(sh_degree=degree))
    inputs = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    summary = run_export(ExportConfig(backdrop="keep"), inputs, tmp_path / "out", CONTEXT)
    assert summary.gaussians == 30
    verify.verify_ply(tmp_path / "out" / "splats.ply", splats)
    write_ply(tmp_path / "out" / "splats.ply", with_harmonics(splats, degree, 0))
    if colored and degree:
        with raises(WorkspaceError, "splats.ply", "sh_rest"):
            verify.verify_ply(tmp_path / "out" / "splats.ply", splats)
