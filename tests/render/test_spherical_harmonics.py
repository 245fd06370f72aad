"""The colour basis against SciPy's associated Legendre functions."""

import torch
from oracle import sh_basis

from recon_cli.render.torch.projection import basis_rest


def test_the_basis_matches_the_associated_legendre_functions():
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1)
    expected = sh_basis(directions, 3)[:, 1:]
    assert torch.allclose(basis_rest(directions, 3), expected, atol=1e-12)
