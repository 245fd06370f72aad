"""Names of axes: every one is turned into a right-handed world whose up is -y or z."""

import numpy as np
import pytest
import torch
from splat_cases import few

from recon_cli.scene.harmonics import basis_rest
from recon_cli.splats.axes import AXES, PLY, Z_UP, flip, signs, turn_from, up_of

# What each letter points at, in a world of right, up and back.
WAYS = {"r": [1, 0, 0], "l": [-1, 0, 0], "u": [0, 1, 0], "d": [0, -1, 0], "b": [0, 0, 1],
        "f": [0, 0, -1]}


def columns(axes):
    """The axes of a file in the world of right, up and back, [3, 3]."""
    return np.array([WAYS[letter] for letter in axes], float).T


@pytest.mark.parametrize("axes", AXES)
def test_a_point_stays_where_it_is_in_the_room(axes):
    ours = PLY if up_of(axes) == "-y" else Z_UP
    splats = few()
    turned = turn_from(axes, splats.as_arrays()).as_tensors()
    before = splats.means.double().numpy() @ columns(axes).T
    after = turned.means.double().numpy() @ columns(ours).T
    assert np.array_equal(before, after)


@pytest.mark.parametrize("axes", ["rub", "ruf", "lbu"])
def test_shapes_and_colours_turn_with_it(axes):
    splats = few()
    turned = turn_from(axes, splats.as_arrays()).as_tensors()
    matrix = np.diag(signs(axes)).astype(float)
    for one, other in zip(_covariances(splats), _covariances(turned), strict=True):
        assert np.allclose(matrix @ one @ matrix.T, other, atol=1e-9 + 1e-6 * np.abs(one).max())
    direction = torch.tensor([[0.36, 0.48, 0.8]], dtype=torch.float64)
    ours = basis_rest(direction * torch.tensor(signs(axes)), 3) @ turned.sh_rest[0].double()
    assert torch.allclose(ours, basis_rest(direction, 3) @ splats.sh_rest[0].double(), atol=1e-6)


def _covariances(splats):
    quats = splats.quats.double().numpy()
    for (w, x, y, z), scale in zip(quats, splats.scales.double().numpy(), strict=True):
        norm = np.linalg.norm([w, x, y, z]) or 1
        w, x, y, z = np.array([w, x, y, z]) / norm if norm else (1, 0, 0, 0)
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
        yield turn @ np.diag(scale ** 2) @ turn.T


def test_turning_twice_changes_nothing_to_the_bit():
    splats = few()
    back = flip(flip(splats.as_arrays(), [1, -1, -1]), [1, -1, -1]).as_tensors()
    for name, value in splats.parameters().items():
        assert torch.equal(getattr(back, name), value), name
