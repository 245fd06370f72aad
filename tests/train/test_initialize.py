"""The first Gaussians."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from facts import raises
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tiny_task import CONFIG, tiny_task

from recon_cli.errors import FormatError, TrainingError
from recon_cli.scene.splats import SH_C0
from recon_cli.train.fit.initialize import first_state, restore_state, splats_from_points
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import save_state
from recon_cli.train.parts.stereo import SurfacePoints

GRID = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), -1).reshape(-1, 3)
GREY = np.full((27, 3), 128, np.uint8)


def test_a_gaussian_is_as_large_as_the_mean_distance_to_its_three_nearest():
    splats = splats_from_points(GRID, GREY, most=100, seed=0, sh_degree=3)
    assert torch.allclose(splats.scales, torch.ones(27, 3))  # a grid of spacing one
    assert splats.opacities.tolist() == pytest.approx([0.1] * 27)


def test_the_base_colour_is_the_points_colour():
    splats = splats_from_points(GRID, GREY, most=100, seed=0, sh_degree=3)
    assert torch.allclose(SH_C0 * splats.sh_dc + 0.5, torch.tensor(128 / 255), atol=1e-6)
    assert splats.sh_rest.abs().max() == 0


@pytest.mark.parametrize("degree", range(4))
def test_no_coefficient_beyond_the_degree_is_stored(degree):
    splats = splats_from_points(GRID, GREY, most=100, seed=0, sh_degree=degree)
    assert splats.sh_rest.shape == (27, (degree + 1) ** 2 - 1, 3)


def test_points_at_one_place_get_a_finite_scale():
    splats = splats_from_points(np.zeros((5, 3)), GREY[:5], most=10, seed=0, sh_degree=3)
    assert torch.isfinite(splats.log_scales).all()


def test_of_too_many_points_a_seeded_draw_is_taken():
    first, second = (splats_from_points(GRID, GREY, most=10, seed=1, sh_degree=3) for _ in range(2))
    assert len(first) == 10
    assert torch.equal(first.means, second.means)


def test_too_few_points_are_refused():
    with raises(TrainingError, 3, "points"):
        splats_from_points(GRID[:3], GREY[:3], most=10, seed=0, sh_degree=3)


@pytest.mark.parametrize(("stereo", "cap", "more"), [
    ("on", 1000, 3), ("off", 1000, 0), ("on", 58, 2), ("on", 54, 0)])
def test_surfaces_by_stereo_begin_with_gaussians_where_sparse_points_leave_room(
        stereo, cap, more):
    surfaces = SurfacePoints(GRID[:3] + 20.0, np.full((3, 3), 200, np.uint8))
    task = tiny_task(replace(CONFIG, stereo=stereo, max_gaussians=cap))
    task = replace(task, evidence=SimpleNamespace(points=GRID, once=lambda *_: surfaces))
    splats = first_state(task, GRID, GREY, most=100).splats
    assert len(splats) == 27 + more
    added = splats.means.detach().numpy()[27:]
    assert {*map(tuple, added)} <= {*map(tuple, surfaces.points)}
    assert torch.allclose(SH_C0 * splats.sh_dc[27:] + 0.5, torch.tensor(200 / 255), atol=1e-6)


def test_without_room_no_surface_is_searched():
    points = np.random.default_rng(0).normal(size=(600, 3))
    task = tiny_task(replace(CONFIG, stereo="on", max_gaussians=1000))
    task = replace(task, evidence=SimpleNamespace(points=points))  # which cannot be searched
    first_state(task, points, np.full((600, 3), 90, np.uint8), most=500)


@pytest.mark.parametrize(("densify", "grey"), [("budget", 0.33), ("reference", None)])
def test_behind_all_gaussians_is_a_grey_backdrop_except_in_the_reference(densify, grey):
    config = replace(CONFIG, densify=densify)
    task = tiny_task(config)
    backdrop = first_state(task, GRID, GREY, most=100).splats.backdrop
    if grey is None:
        assert backdrop is None
        return
    assert backdrop.color == (grey,) * 3
    for view in task.train:
        away = view.camera.center - [backdrop.x, backdrop.y, backdrop.z]
        assert np.linalg.norm(away) <= backdrop.reach


@pytest.mark.integration
def test_a_run_keeps_its_backdrop_from_one_checkpoint_to_the_next(tmp_path):
    task = tiny_task(replace(CONFIG, densify="budget"))
    state = first_state(task, GRID, GREY, most=100)
    assert state.splats.backdrop is not None
    save_state(tmp_path / "a.safetensors", state)
    assert restore_state(tmp_path / "a.safetensors", task).splats.backdrop == state.splats.backdrop
    begin = state.splats.backdrop
    fit(state, task, 30)  # with densification
    assert state.splats.backdrop == begin


@pytest.mark.parametrize("backdrop", ["absent", None, [1, 2], "grey"])
def test_a_checkpoint_without_a_backdrop_is_on_black_and_a_damaged_one_is_refused(
    tmp_path, backdrop
):
    task, path = tiny_task(replace(CONFIG, densify="budget")), tmp_path / "a.safetensors"
    save_state(path, first_state(task, GRID, GREY, most=100))
    with safe_open(path, framework="pt") as file:
        scalars = json.loads(file.metadata()["state"]) | {"backdrop": backdrop}
    if backdrop == "absent":  # as before there were any
        del scalars["backdrop"]
    save_file(load_file(path), path, metadata={"state": json.dumps(scalars)})
    if backdrop in ("absent", None):
        assert restore_state(path, task).splats.backdrop is None
        return
    with raises(FormatError):
        restore_state(path, task)
