"""The smallest turn from one direction to another."""

import numpy as np
import pytest

from recon_cli.scene.gravity import turn_onto

X, Y, Z = np.eye(3)
RNG = np.random.default_rng(0)
PAIRS = [one / np.linalg.norm(one, axis=1, keepdims=True) for one in RNG.normal(size=(20, 2, 3))]


@pytest.mark.parametrize(("one", "other"), [
    *PAIRS, (X, X), (Z, -Z), (X, -X), (PAIRS[0][0], -PAIRS[0][0]),
    (Z, np.array([1e-9, 0, -1]))])
def test_it_is_a_rotation_that_takes_one_to_the_other(one, other):
    turn = turn_onto(one, other)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-7)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert np.allclose(turn @ one, other, atol=1e-7)


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_no_rotation_that_does_it_is_smaller(one, other):
    angle = np.arccos((np.trace(turn_onto(one, other)) - 1) / 2)
    assert angle == pytest.approx(np.arccos(one @ other))


@pytest.mark.parametrize(("one", "other", "turned"), [
    (Z, Y, [X, Z, -Y]), (Z, -Y, [X, -Z, Y]), (Y, -Y, [X, -Y, -Z]), (Z, Z, [X, Y, Z])])
def test_between_axes_it_is_exact_and_leaves_x(one, other, turned):
    # The rows say what x, y and z of the new frame were in the old one.
    assert np.array_equal(turn_onto(one, other), np.array(turned))
