"""Photometry of training images: what a run fits, keeps in its state, and hands to evaluation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_task import CONFIG, EXTENT, first_state, same, tiny_task

from recon_cli.render.response import ResponseGradient, transmission
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import load_state, save_state
from recon_cli.train.parts.exposure import Exposure
from recon_cli.train.parts.photometry import Photometry, read_falloffs, write_photometry
from recon_cli.train.parts.vignette import Vignettes, falling
from recon_cli.workspace.summaries import PhotometrySummary

pytestmark = pytest.mark.integration
ALL = replace(CONFIG, exposure="on", vignette="on", sh_degree=1)


def photometry(task, seed=0):
    count = len(task.train)
    start = np.random.default_rng(seed).normal(0, 0.2, (count, 3))
    return Photometry([
        Exposure(count, start=start), Vignettes([view.camera for view in task.train])])


def exponents(made):
    return [(each.a, each.b) for each in made.summarize().vignettes]


def darkening(a, b):
    return ResponseGradient(np.zeros(3), np.array([a, b]))


@pytest.mark.parametrize("until", [17, 45])
def test_a_run_that_is_saved_and_loaded_ends_with_the_same_bytes(tmp_path, until):
    task = tiny_task(ALL, backend="numba")
    whole, halves = (first_state(ALL, backend="numba") for _ in range(2))
    for state in (whole, halves):
        state.photometry = photometry(task)
    before = exponents(whole.photometry)
    fit(whole, task, 60)
    fit(halves, task, until)
    save_state(tmp_path / "state.safetensors", halves)
    halves = load_state(
        tmp_path / "state.safetensors", ALL, EXTENT, torch.device("cpu"), backend="numba",
        photometry=photometry(task, seed=1))
    fit(halves, task, 60)
    assert same(whole, halves)
    for name, value in whole.photometry.tensors().items():
        assert torch.equal(value, halves.photometry.tensors()[name]), name
    assert exponents(whole.photometry) != before


@pytest.mark.parametrize("asked", [
    (0.3, 0.2), (-0.2, 0.5), (0.1, -0.4), (-0.3, -0.1), (-4.0, -3.0), (0.0, 0.0)])
def test_a_vignette_falls_from_the_middle_to_the_corner(asked):
    a, b = falling(*asked)
    squares = np.linspace(0, 1, 50)
    left = np.exp(a * squares + b * squares**2)
    assert left[0] == 1
    assert (np.diff(left) <= 1e-12).all()
    assert left[-1] > 0.2
    assert falling(a, b) == pytest.approx((a, b))


def test_views_of_one_lens_share_a_vignette():
    task = tiny_task(ALL)  # of five focal lengths
    cameras = [task.train[0].camera, task.train[1].camera, task.train[0].camera]
    found = Vignettes(cameras, start=np.array([[-0.1, 0.0], [-0.3, 0.0]]))
    found.step(2, darkening(5.0, 0.0), 0.0)
    assert found.of_image(0) == found.of_image(2)
    assert found.of_image(0)[0] < -0.1
    assert found.of_image(1) == (-0.3, 0.0)


def test_what_was_found_is_recorded_and_read_by_evaluation(tmp_path):
    task = tiny_task(ALL)
    made = photometry(task)
    made.step(0, darkening(1.0, 1.0), 0.0)
    write_photometry(tmp_path, made)
    record = PhotometrySummary.read(tmp_path)
    start = photometry(task).response(0).gain  # the start has a spread of .2
    assert np.array_equal(made.response(0).gain, start)
    assert 0.1 < record.gain_spread < 0.4
    camera = task.train[0].camera
    white = np.ones((camera.height, camera.width, 3), np.float32)
    shaded = read_falloffs(tmp_path).shade(white, camera)
    assert shaded[..., 0] == pytest.approx(transmission(camera, made.response(0).vignette))
    assert shaded.min() < 1


def test_nothing_is_recorded_where_nothing_was_fitted(tmp_path):
    write_photometry(tmp_path, None)
    assert not list(tmp_path.iterdir())
    assert read_falloffs(tmp_path) is None
    write_photometry(tmp_path, Photometry([Exposure(3)]))
    assert read_falloffs(tmp_path) is None
