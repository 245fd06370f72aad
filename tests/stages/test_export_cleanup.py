"""export cleans floaters and islands away where it is asked to, and says what that costs."""

from __future__ import annotations

import logging

import pytest
import torch
from facts import assert_facts, raises
from foreign import truth
from tiny_scene import make_inputs
from tiny_stages import run_export

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import ImportConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, StageError
from recon_cli.scene.splats import Splats, joined
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.stages import import_scene

CONTEXT = StageContext(backend="numba")


def floating(places, scale):
    n = len(places)
    return Splats(
        torch.tensor(places), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.full((n, 3), scale).log(), torch.full((n,), 0.5), torch.full((n, 3), 1.5),
        torch.zeros(0, 0, 3))


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """The tiny scene with three floaters before its cameras, held against its views."""
    folder = tmp_path_factory.mktemp("tiny")
    inputs = make_inputs(folder)
    planted, order = joined([truth(), floating([(0.0, 0, 1.0), (0.3, 0.2, 1.3), (-0.3, 0, 1.6)],
                                               0.05)])
    write_ply(folder / "scene.ply", planted)
    (folder / "train").mkdir()
    import_scene.run(ImportConfig(), StageInputs(inputs.folders, (folder / "scene.ply",)),
                 folder / "train", CONTEXT)
    return StageInputs({**inputs.folders, "train": folder / "train"}), order >= len(truth())


def exported(given, out, **options):
    return run_export(ExportConfig(**options), given, out, CONTEXT)


def test_planted_floaters_go_and_the_views_gain(given, tmp_path, caplog):
    inputs, floats = given
    caplog.set_level(logging.INFO, "recon")
    summary = exported(inputs, tmp_path, drop_floaters=True)
    (change,) = summary.changes
    assert change.option == "drop_floaters"
    assert change.psnr_change_db > 5
    whole = read_ply(inputs.folders["train"] / "splats.ply")
    left = {tuple(mean) for mean in read_ply(tmp_path / "splats.ply").means.tolist()}
    assert not left & {tuple(mean) for mean in whole.means[floats].tolist()}
    assert len(left) >= 0.9 * len(truth())  # some lie outside all views
    assert_facts(caplog.text, "make", "views", "worse")


def test_the_same_goes_whatever_the_units_of_the_export(given, tmp_path):
    inputs, _ = given
    counts = []
    for at, scale in enumerate((None, ("000001.png", "000006.png", 7.0))):
        (tmp_path / str(at)).mkdir()
        counts.append(exported(inputs, tmp_path / str(at), drop_floaters=True, drop_islands=True,
                               scale_between=scale).changes)
    for one, two in zip(*counts, strict=True):
        assert one.gaussians == two.gaussians


def test_floaters_and_islands_go_before_the_crop(given, tmp_path):
    inputs, _ = given
    low, high = (float(truth().means[:, 0].quantile(q)) for q in (0.1, 0.9))
    summary = exported(inputs, tmp_path, drop_floaters=True, drop_islands=True, sh_degree=0,
                       crop=(low, -1e3, -1e3, high, 1e3, 1e3))
    assert [one.option for one in summary.changes] == [
        "drop_floaters", "drop_islands", "crop"]


def test_nothing_goes_unasked(given, tmp_path):
    inputs, _ = given
    assert exported(inputs, tmp_path).changes is None
    assert len(read_ply(tmp_path / "splats.ply")) == len(truth()) + 3


def test_islands_go_without_views_and_floaters_are_refused(tmp_path):
    wall = [(0.1 * x, 0.1 * y, 0.0) for x in range(30) for y in range(30)]
    write_ply(tmp_path / "scene.ply", joined([
        floating(wall, 0.06), floating([(1.5, 1.5, 1.5), (1.5, 1.55, 1.5)], 0.05)])[0])
    (tmp_path / "train").mkdir()
    import_scene.run(ImportConfig(max_size=96), StageInputs({}, (tmp_path / "scene.ply",)),
                 tmp_path / "train", CONTEXT)
    inputs = StageInputs({"train": tmp_path / "train"})
    summary = exported(inputs, tmp_path, drop_islands=True)
    assert summary.gaussians == 900
    assert read_ply(tmp_path / "splats.ply").means[:, 2].abs().max() == 0
    with raises(StageError, "--drop-floaters"):
        exported(inputs, tmp_path, drop_floaters=True)


def test_a_scene_in_another_frame_is_not_cleaned_by_the_views(given, tmp_path):
    inputs, _ = given
    away = truth()
    away.means += torch.tensor([1.0, 1.0, 0.0])
    write_ply(tmp_path / "away.ply", away)
    (tmp_path / "train").mkdir()
    import_scene.run(ImportConfig(), StageInputs(
        {name: inputs.folders[name] for name in ("ingest", "place")}, (tmp_path / "away.ply",)),
        tmp_path / "train", CONTEXT)
    with raises(StageError, "--drop-floaters"):
        exported(StageInputs({**inputs.folders, "train": tmp_path / "train"}), tmp_path,
                 drop_floaters=True)


def test_a_scene_that_no_view_sees_is_not_dropped_whole(given, tmp_path):
    inputs, _ = given
    behind = truth()
    behind.means[:, 2] -= 100
    (tmp_path / "train").mkdir()
    for path in inputs.folders["train"].iterdir():
        (tmp_path / "train" / path.name).write_bytes(path.read_bytes())
    write_ply(tmp_path / "train" / "splats.ply", behind)
    with raises(ConfigError, "remove"):
        exported(StageInputs({**inputs.folders, "train": tmp_path / "train"}), tmp_path,
                 drop_floaters=True)
