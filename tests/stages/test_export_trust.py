"""`recon export --trust`: the expected error of each Gaussian in the .ply."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from facts import raises
from tiny_stages import CONTEXT, run_export

from recon_cli.config.export import ExportConfig
from recon_cli.errors import StageError
from recon_cli.splats.ply import read_ply
from recon_cli.splats.ply_tables import read_header, read_tables
from recon_cli.trust.ply_property import PLY_PROPERTY, match_rows
from recon_cli.workspace.records import ImportRecord


@pytest.fixture
def inputs(tiny_learnt):
    """A short training of the tiny scene, with harmonics."""
    return tiny_learnt


def exported(inputs, out, **options):
    out.mkdir()
    run_export(ExportConfig(**options), inputs, out, CONTEXT)
    return read_tables(read_header(out / "splats.ply"))["vertex"]


def test_the_property_comes_last_and_stays_with_its_gaussian(inputs, tmp_path):
    plain = exported(inputs, tmp_path / "plain")
    table = exported(inputs, tmp_path / "with", trust=True)
    assert table.dtype.names == (*plain.dtype.names, PLY_PROPERTY)
    for name in plain.dtype.names:
        np.testing.assert_array_equal(table[name], plain[name])
    back = read_ply(tmp_path / "with" / "splats.ply")  # as others read it
    errors = table[PLY_PROPERTY][:len(back)]  # nothing is known of the backdrop's
    assert ((errors > 0) & (errors <= 1)).all()
    assert len(np.unique(errors)) > len(errors) // 2
    assert torch.equal(back.means, read_ply(tmp_path / "plain" / "splats.ply").means)
    x = table["x"][:len(back)]
    middle = float(np.median(x))
    moved = exported(
        inputs, tmp_path / "moved", trust=True, crop=(-1e3, -1e3, -1e3, 2 * middle, 1e3, 1e3),
        transform=(2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(moved[PLY_PROPERTY], errors[x <= middle], rtol=1e-5)



def test_a_scene_without_views_has_no_property_and_says_why(inputs, tmp_path):
    train = inputs.folders["train"]
    record = train / "import.json"
    ImportRecord("room.ply", "ply", "0", 1, 0, z_up=True, views=False).write(train)
    try:
        with raises(StageError, "imported", "views"):
            exported(inputs, tmp_path / "out", trust=True)
    finally:
        record.unlink()


def test_rows_are_found_again_whatever_was_left_out():
    means = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    rows = torch.tensor([40, 3, 17])
    assert match_rows(means[rows], means.double().numpy()).tolist() == rows.tolist()
