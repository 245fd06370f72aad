"""The expected error: monotone, calibrated, and composited as colours are."""

import numpy as np
import pytest
import torch
from small_room import camera, dots, photo, room

from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.render import render
from recon_cli.scene.splats import SH_C0
from recon_cli.trust.error_model import (
    PRIOR,
    TERMS,
    ErrorModel,
    calibrate,
    fit_weights,
    paint,
    picture_terms,
)
from recon_cli.trust.support import measure_support

MODEL = ErrorModel(bias=-1.0, weights=dict(PRIOR), means=dict.fromkeys(TERMS, 0.0), views=1,
                   calibrated=True)


def test_the_fit_gets_the_mean_error_right_and_no_weight_is_negative():
    rng = np.random.default_rng(0)
    terms = rng.random((20_000, len(TERMS)))
    true = np.array([PRIOR[name] for name in TERMS]) + 0.3
    errors = np.exp(-4 + terms @ true - 2 * terms[:, 0]) * rng.exponential(size=len(terms))
    bias, weights = fit_weights(terms, errors)
    expected = np.exp(bias + terms @ weights)
    assert expected.mean() == pytest.approx(errors.mean(), rel=1e-3)
    assert (weights >= 0).all()
    assert weights[0] < PRIOR["hole"]  # as errors fall with it


def test_without_views_the_weights_stay_and_the_mean_is_right():
    terms = np.random.default_rng(0).random((500, len(TERMS)))
    bias, weights = fit_weights(terms, np.full(500, 0.02), fixed=True)
    assert weights.tolist() == list(PRIOR.values())
    assert np.exp(bias + terms @ weights).mean() == pytest.approx(0.02)


@pytest.mark.parametrize("name", TERMS)
def test_the_expected_error_never_falls_with_a_term(name):
    terms = {other: np.zeros(5, np.float32) for other in TERMS}
    terms[name] = np.linspace(-3, 4, 5, dtype=np.float32)
    expected = MODEL.expect(terms)
    assert (np.diff(expected) >= 0).all()
    assert expected[-1] > expected[0]
    assert expected.max() <= 1


def test_values_are_composited_exactly_as_colours():
    splats = dots(room(step=0.5))
    view = camera([0, 0, 1.2], [2, 0.3, 1])
    with torch.no_grad():
        rgb = render(splats, view, torch.zeros(3), 0, backend="torch").rgb.numpy()
    values = (splats.sh_dc * SH_C0 + 0.5).clamp_min(0)
    np.testing.assert_allclose(paint(splats, view, list(values.T), "torch"), rgb, atol=1e-5)


@pytest.mark.integration
def test_holes_and_sides_that_no_view_shows_are_not_trusted():
    splats = dots(room(step=0.2), radius=0.12)
    eyes = [[0, y, 1.5] for y in (-0.5, 0.0, 0.5)]
    views = [photo(splats, camera(eye, [2, eye[1], 1.2])) for eye in eyes]  # the wall at x = 2
    support = measure_support(splats, views, sh_degree=0, backend="torch")
    rendered = RenderedModel(splats, 0, "torch")
    model = calibrate(
        rendered, support, [photo(splats, camera([0, 0.25, 1.5], [2, 0.2, 1.2]))], views)
    assert model.calibrated
    assert calibrate(rendered, support, [], views).calibrated is False

    def expect(target):
        picture = picture_terms(rendered, support, camera([0, 0.1, 1.5], target))
        return picture, model.expect(picture.terms)

    _, seen = expect([2, 0, 1.2])
    _, unseen = expect([-2, 0, 1.2])
    assert np.median(unseen) > 1.5 * np.median(seen)
    picture, sky = expect([0.3, 0.1, 9.0])  # no ceiling
    assert picture.alpha[12, 16] < 0.01
    assert sky[12, 16] >= np.median(unseen)
