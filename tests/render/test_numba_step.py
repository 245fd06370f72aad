"""The training step without autograd: its memory, and that it is the same as with autograd."""

import gc
import weakref

import numpy as np
import pytest
import torch
from scenes import camera_at, leaves, random_splats

from recon_cli.experiments.synthetic_room import room
from recon_cli.render import render
from recon_cli.render.contract import StepOptions, TargetImage
from recon_cli.render.numba import backend
from recon_cli.render.numba.step import PhotometricStep
from recon_cli.train.fit.gradient import photometric_loss

BLACK = torch.zeros(3)
MOST_BUFFERS = 60e6  # bytes, for 100,000 Gaussians at 640x360


@pytest.mark.integration
def test_the_buffers_of_a_step_stay_small():
    splats, camera = room(100_000, 640, 360)
    step = PhotometricStep()
    step(splats, splats.map(torch.empty_like), camera,
         TargetImage(np.zeros((360, 640, 3), np.uint8)), StepOptions(3, 0.2))
    assert step.bytes <= MOST_BUFFERS


def test_the_fused_step_gives_the_gradients_of_autograd():
    camera = camera_at(60, 41)
    truth = np.random.default_rng(0).integers(0, 256, (41, 60, 3), np.uint8)
    splats = leaves(random_splats(200, seed=13, dtype=torch.float32))
    gradients = splats.map(lambda tensor: torch.full_like(tensor, torch.nan))
    step = PhotometricStep()
    loss = step(splats, gradients, camera, TargetImage(truth), StepOptions(3, 0.2))
    output = render(splats, camera, BLACK, 3, backend="numba")
    expected = photometric_loss(output.rgb, torch.from_numpy(truth).float() / 255, 0.2)
    expected.backward()
    assert abs(loss - expected.item()) < 1e-6
    for name, value in gradients.parameters().items():
        theirs = getattr(splats, name).grad
        assert (value - theirs).norm() <= 1e-5 * theirs.norm(), name
    mine, theirs = step.statistics.means2d_grad, output.statistics.means2d_grad
    assert (mine - theirs).norm() <= 1e-5 * theirs.norm()


def test_the_buffers_of_a_view_are_free_again_when_its_image_goes(monkeypatch):
    held = []

    class Watched(backend.Lease):
        def __init__(self):
            super().__init__()
            held.append(weakref.ref(self))

    monkeypatch.setattr(backend, "Lease", Watched)
    splats = leaves(random_splats(20, dtype=torch.float32))
    gc.disable()  # at once, and not when the collector comes by
    try:
        for _ in range(3):
            output = render(splats, camera_at(), BLACK, 3, backend="numba")
            output.rgb.sum().backward()
            del output
        assert len(held) == 3
        assert not any(lease() for lease in held)
    finally:
        gc.enable()


def test_a_read_only_photograph_is_taken():
    camera = camera_at(20, 20)
    truth = np.zeros((20, 20, 3), np.uint8)
    truth.flags.writeable = False
    splats = random_splats(5, dtype=torch.float32)
    assert np.isfinite(PhotometricStep()(
        splats, splats.map(torch.empty_like), camera, TargetImage(truth), StepOptions(0, 0.2)))


def test_the_fused_step_gives_the_scores_of_the_renderer():
    camera = camera_at(60, 41)
    truth = np.random.default_rng(0).integers(0, 256, (41, 60, 3), np.uint8)
    mask = np.random.default_rng(1).random((41, 60)) < 0.5
    splats = leaves(random_splats(200, seed=13, dtype=torch.float32))
    step = PhotometricStep()
    for counting in (None, mask, None):  # one after the other: nothing adds up
        step(splats, splats.map(torch.empty_like), camera, TargetImage(truth, counting),
             StepOptions(3, 0.2, scores=True, loo=True))
        output = render(splats, camera, BLACK, 3, backend="numba", scores=True,
                        mask=None if counting is None else torch.from_numpy(counting))
        output.rgb.sum().backward()
        for name in ("hits", "blend_sum", "blend_max", "loo"):
            assert torch.equal(
                getattr(step.statistics, name), getattr(output.statistics, name)), name


def test_without_harmonics_their_gradient_is_left_alone_and_the_others_are_the_same():
    camera = camera_at(60, 41)
    truth = np.random.default_rng(0).integers(0, 256, (41, 60, 3), np.uint8)
    splats = random_splats(200, seed=13, dtype=torch.float32)
    whole, part = (splats.map(lambda tensor: torch.full_like(tensor, 7.0)) for _ in range(2))
    step = PhotometricStep()
    for gradients, harmonics in ((whole, True), (part, False)):
        step(splats, gradients, camera, TargetImage(truth),
             StepOptions(3, 0.2, harmonics=harmonics))
    assert (part.sh_rest == 7).all()
    assert not (whole.sh_rest == 7).any()
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc"):
        assert torch.equal(getattr(whole, name), getattr(part, name)), name


def test_asking_for_scores_changes_no_gradient():
    camera = camera_at(60, 41)
    truth = np.random.default_rng(0).integers(0, 256, (41, 60, 3), np.uint8)
    splats = random_splats(200, seed=13, dtype=torch.float32)
    found = []
    for scores in (False, True):
        gradients = splats.map(torch.empty_like)
        PhotometricStep()(
            splats, gradients, camera, TargetImage(truth),
            StepOptions(3, 0.2, scores=scores, loo=scores))
        found.append(gradients.parameters().values())
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
