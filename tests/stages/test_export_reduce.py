"""export takes away what it is asked to, and says what that costs."""

from __future__ import annotations

import logging

import pytest
import torch
from tiny_stages import CONTEXT

from recon_cli.config.stages import ExportConfig
from recon_cli.errors import ConfigError
from recon_cli.export.reduce import fit_to_size
from recon_cli.io.ply import read_ply
from recon_cli.io.splats.registry import FORMATS
from recon_cli.stages import export


@pytest.fixture
def inputs(tiny_learnt):
    """A short training of the tiny scene, with harmonics."""
    return tiny_learnt


@pytest.fixture
def whole(inputs):
    """The trained scene."""
    return read_ply(inputs.folders["train"] / "splats.ply")


def exported(inputs, out, **options):
    return export.run(ExportConfig(**options), inputs, out, CONTEXT)


def test_a_crop_keeps_the_centres_in_the_box_and_says_what_went(inputs, whole, tmp_path, caplog):
    caplog.set_level(logging.INFO, "recon")
    middle = whole.means.median(dim=0).values
    box = (-1e3, -1e3, -1e3, float(middle[0]), 1e3, 1e3)
    summary = exported(inputs, tmp_path, crop=box)
    kept = whole.means[whole.means[:, 0] <= middle[0]]
    assert torch.equal(read_ply(tmp_path / "splats.ply").means, kept)
    (change,) = summary.changes
    assert (change.gaussians, change.gaussians_before) == (len(kept), len(whole))
    assert change.psnr_change_db < -0.5  # half of the scene is gone
    assert any(line.startswith(f"crop: {len(kept)} of {len(whole)}") for line in caplog.messages)


def test_a_crop_is_in_units_of_the_exported_scene(inputs, whole, tmp_path):
    scaled = exported(inputs, tmp_path, scale_between=("000000.png", "000006.png", 7.0))
    scale = scaled.transform["scale"]
    middle = float(scale * whole.means[:, 0].median())
    exported(inputs, tmp_path, scale_between=("000000.png", "000006.png", 7.0),
             crop=(-1e6, -1e6, -1e6, middle * (1 + 1e-6), 1e6, 1e6))
    assert len(read_ply(tmp_path / "splats.ply")) == -(-len(whole) // 2)


def test_a_box_without_gaussians_is_refused_with_where_they_are(inputs, tmp_path):
    with pytest.raises(ConfigError, match="No Gaussian has its centre") as caught:
        exported(inputs, tmp_path, crop=(1e5, 1e5, 1e5, 2e5, 2e5, 2e5))
    assert "Nine tenths" in caught.value.hint
    with pytest.raises(ConfigError, match="lowest and a highest corner"):
        ExportConfig(crop=(1.0, 0.0, 0.0, 0.0, 1.0, 1.0))


def test_a_lower_degree_cuts_the_harmonics_off(inputs, whole, tmp_path):
    summary = exported(inputs, tmp_path, sh_degree=1)
    back = read_ply(tmp_path / "splats.ply")
    assert back.sh_degree == 1
    assert torch.equal(back.sh_rest, whole.sh_rest[:len(back.sh_rest), :3])
    (change,) = summary.changes
    assert (change.degree, change.degree_before) == (1, 3)


@pytest.mark.parametrize("name", ["ply", "spz", "sog"])
def test_a_file_is_no_larger_than_asked_for(inputs, whole, tmp_path, name):
    exported(inputs, tmp_path, format=name)
    path = tmp_path / f"splats.{name}"
    most = 0.6 * path.stat().st_size / 1e6
    summary = exported(inputs, tmp_path, format=name, max_mb=most)
    assert path.stat().st_size <= 1e6 * most
    (change,) = summary.changes
    assert change.gaussians < len(whole) or change.degree < 3
    assert len(FORMATS[name].read(path)) == change.gaussians
    assert summary.gaussians == change.gaussians


def test_the_size_is_met_by_what_looks_best(whole):
    asked = []

    def psnr_db(splats):
        asked.append((splats.sh_degree, len(splats)))
        return -abs(splats.sh_degree - 1)  # a scene that looks best at degree 1

    best = fit_to_size(
        whole, 68 * 40 + 2000, size_of=lambda splats: len(splats) * (
            68 + 12 * (0, 3, 8, 15)[splats.sh_degree]) + 1500,
        score_of=lambda splats: torch.arange(len(splats)).double(), psnr_db=psnr_db)
    assert best.sh_degree == 1
    assert [degree for degree, _ in asked] == [3, 2, 1, 0]
    counts = [count for _, count in asked]
    assert counts == sorted(counts)  # fewer coefficients leave room for more Gaussians
    assert torch.equal(best.means, whole.means[-len(best):])  # those of the highest scores


def test_what_no_gaussian_fits_into_is_refused(inputs, tmp_path):
    with pytest.raises(ConfigError, match="Not even one"):
        exported(inputs, tmp_path, max_mb=1e-4)
    with pytest.raises(ConfigError, match="holds no Gaussians"):
        exported(inputs, tmp_path, format="colmap", max_mb=1.0)


def test_a_limit_that_is_met_anyway_changes_nothing(inputs, whole, tmp_path):
    summary = exported(inputs, tmp_path, max_mb=100.0)
    assert summary.changes[0].gaussians == len(whole)
    assert torch.equal(read_ply(tmp_path / "splats.ply").means, whole.means)
