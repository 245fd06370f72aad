"""Early gains: what they are multiplied into, when, and that a resumed run has the same bytes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_task import CONFIG, EXTENT, first_state, same, tiny_task

from recon_cli.render import render
from recon_cli.train.exposure import Exposure
from recon_cli.train.filmed_brightness import restore_brightness
from recon_cli.train.fit import fit
from recon_cli.train.photometry import Curves, Photometry, Vignettes
from recon_cli.train.schedule import ContinuedSchedule, Schedule
from recon_cli.train.state import load_state, save_state

pytestmark = pytest.mark.integration
EARLY = replace(CONFIG, exposure="early", tone="on", vignette="on", sh_degree=1)


def photometry(task, seed=0):
    count = len(task.train)
    start = np.random.default_rng(seed).normal(0, 0.2, (count, 3))
    return Photometry(
        Exposure(count, start=start), Curves(count, start=start[:, 0] / 2),
        Vignettes([view.camera for view in task.train]))


def picture(state, task):
    with torch.no_grad():
        return render(state.splats, task.train[0].camera, state.splats.background, 1,
                      backend="numba").rgb.numpy()


def test_one_gain_for_all_views_brightens_the_scene_by_it():
    task, state = tiny_task(EARLY, backend="numba"), first_state(EARLY, backend="numba")
    state.photometry = photometry(task)
    gains = np.tile(np.log([1.2, 1.0, 0.9]), (len(task.train), 1))
    state.photometry.exposure._rows.value = torch.from_numpy(gains)
    before = picture(state, task)
    restore_brightness(state, task)
    after = picture(state, task)
    shown = before.min(axis=2) > 0.01
    assert shown.any()
    assert after[shown] == pytest.approx(before[shown] * [1.2, 1.0, 0.9], rel=1e-4)


def test_a_gaussian_that_one_view_shows_gets_the_gain_of_that_view():
    task, state = tiny_task(EARLY, backend="numba"), first_state(EARLY, backend="numba")
    behind = replace(task.train[0].camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]))
    task.train[1:] = [replace(view, camera=behind) for view in task.train[1:]]
    state.photometry = photometry(task)
    with torch.no_grad():
        weights = [render(state.splats, view.camera, state.splats.background, 0, backend="numba",
                          scores=True).statistics.blend_sum for view in task.train[:2]]
        alone = (weights[0] > 0) & (weights[1] == 0)
        colors = 0.5 + 0.28209479177387814 * state.splats.sh_dc.clone()
        restore_brightness(state, task)
        ratios = (0.5 + 0.28209479177387814 * state.splats.sh_dc) / colors
    assert alone.any()
    expected = np.exp(state.photometry.exposure.log_gains[0])
    assert ratios[alone].numpy() == pytest.approx(
        np.tile(expected, (int(alone.sum()), 1)), rel=1e-4)


def test_early_gains_end_once_and_not_after_the_state_for_pruning():
    for iterations in (60, 61, 62, 999, 2402):
        schedule = Schedule(replace(EARLY, iterations=iterations, mid=0.6))
        restored = [i for i in range(1, iterations + 1) if schedule.restores(i)]
        assert restored == [schedule.mid]
        assert schedule.compensates(schedule.mid)
        assert not schedule.compensates(schedule.mid + 1)
    always = Schedule(replace(EARLY, exposure="on"))
    assert always.compensates(60)
    assert not any(always.restores(i) for i in range(1, 61))
    continued = ContinuedSchedule(replace(EARLY, iterations=90), first=60)
    assert not any(continued.compensates(i) or continued.restores(i) for i in range(61, 91))


@pytest.mark.parametrize("backend", ["torch", "numba"])
@pytest.mark.parametrize("until", [17, 36, 45])
def test_a_run_that_is_saved_and_loaded_ends_with_the_same_bytes(tmp_path, backend, until):
    task = tiny_task(EARLY, backend=backend)
    whole, halves = (first_state(EARLY, backend=backend) for _ in range(2))
    for state in (whole, halves):
        state.photometry = photometry(task)
    fit(whole, task, 60)
    fit(halves, task, until)
    save_state(tmp_path / "state.safetensors", halves)
    halves = load_state(
        tmp_path / "state.safetensors", EARLY, EXTENT, torch.device("cpu"), backend=backend,
        photometry=photometry(task, seed=1))
    fit(halves, task, 60)
    assert same(whole, halves)
    for name, value in whole.photometry.tensors().items():
        assert torch.equal(value, halves.photometry.tensors()[name]), name


def test_after_the_gains_end_no_image_has_a_gain_or_curve_but_its_lens():
    task = tiny_task(EARLY)
    found = photometry(task)
    assert found.response(0, own=False).gain.tolist() == [1, 1, 1]
    assert found.response(0, own=False).bend is None
    assert found.response(0, own=False).vignette == found.vignettes.of_image(0)
    assert Photometry(found.exposure, found.curves, None).response(0, own=False) is None
