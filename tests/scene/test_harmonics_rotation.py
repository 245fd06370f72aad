"""Turned colours, seen along a turned direction, are the colours that were."""

import numpy as np
import pytest
import torch
from test_similarity import random_rotation

from recon_cli.scene.harmonics import basis_rest, rotate_sh, rotation_blocks

EXACT = 1e-12
DEGREES = {1: slice(0, 3), 2: slice(3, 8), 3: slice(8, 15)}


def directions(count: int = 50) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=1)


def rotations(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [random_rotation(rng) for _ in range(count)]


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("rotation", rotations(8))
def test_a_turned_function_has_the_old_value_in_the_turned_direction(degree, rotation):
    seen = directions()
    turned = seen @ torch.from_numpy(rotation).T
    sh = torch.randn(4, 15, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    alone = torch.zeros_like(sh)
    alone[:, DEGREES[degree]] = sh[:, DEGREES[degree]]
    before = torch.einsum("dj,njc->ndc", basis_rest(seen, 3), alone)
    after = torch.einsum("dj,njc->ndc", basis_rest(turned, 3), rotate_sh(alone, rotation))
    assert torch.allclose(before, after, rtol=0, atol=EXACT)


def test_no_rotation_is_the_identity():
    for block in rotation_blocks(np.eye(3)):
        assert torch.allclose(block, torch.eye(len(block), dtype=torch.float64), atol=EXACT)


def test_two_rotations_are_their_product_and_the_transpose_leads_back():
    first, second = rotations(2)
    for a, b, both, back in zip(
            rotation_blocks(first), rotation_blocks(second), rotation_blocks(second @ first),
            rotation_blocks(first.T), strict=True):
        assert torch.allclose(b @ a, both, rtol=0, atol=EXACT)
        assert torch.allclose(a.T, back, rtol=0, atol=EXACT)


def test_degree_one_is_the_rotation_itself_in_the_order_of_the_basis():
    """Degree 1 is (-y, z, -x), so that its matrix is R with rows and columns taken like this."""
    rotation, = rotations(1)
    order = np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    expected = torch.from_numpy(order @ rotation @ order.T)
    assert torch.allclose(rotation_blocks(rotation)[0], expected, rtol=0, atol=EXACT)


QUARTER = {  # columns are the images of x, y, z
    "x": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "y": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "z": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


@pytest.mark.parametrize("axis", QUARTER)
def test_a_quarter_turn_swaps_the_axes_of_degree_one_with_signs(axis):
    block = rotation_blocks(QUARTER[axis].astype(np.float64))[0]
    assert torch.allclose(block, block.round(), rtol=0, atol=EXACT)
    assert torch.equal(block.round().abs().sum(0), torch.ones(3, dtype=torch.float64))


def test_a_quarter_turn_about_z_swaps_and_signs_the_terms_of_every_degree():
    """Terms come as m = -l..l; +m and -m turn by 90 m degrees, in this basis without a sign of m.

    By hand: x -> y and y -> -x. xy becomes -xy; xx - yy becomes yy - xx; -yz becomes the function
    that -xz stands for, with the sign of the turn; zz stays.
    """
    blocks = rotation_blocks(QUARTER["z"].astype(np.float64))
    degree2 = torch.zeros(5, 5, dtype=torch.float64)
    degree2[0, 0] = degree2[4, 4] = -1  # xy, xx - yy
    degree2[2, 2] = 1  # zz
    degree2[1, 3], degree2[3, 1] = 1, -1  # f = -xz is seen as -(x'z') with x' = y: -yz
    assert torch.allclose(blocks[1], degree2, rtol=0, atol=EXACT)
    for block in blocks:
        assert torch.allclose(block, block.round(), rtol=0, atol=EXACT)
        assert torch.equal(block.round().abs().sum(0), torch.ones(len(block), dtype=torch.float64))


def test_the_dtype_is_kept_and_float32_is_rounded_once():
    rotation, = rotations(1)
    sh = torch.randn(3, 15, 3, generator=torch.Generator().manual_seed(0))
    turned = rotate_sh(sh, rotation)
    assert turned.dtype == torch.float32
    assert torch.equal(turned, rotate_sh(sh.double(), rotation).float())
