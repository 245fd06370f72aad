"""Files of other programs: all are read, and one scene in several formats is one scene."""

import numpy as np
import pytest
import torch
from splat_cases import greatest, rotation_error

from recon_cli.scene.splats import SH_C0
from recon_cli.splats.compressed_ply import load_compressed_ply
from recon_cli.splats.ply import read_ply
from recon_cli.splats.splat import FORMAT
from recon_cli.splats.spz import load_spz


@pytest.fixture
def points(shared_data):
    """The same three Gaussians in several formats, by suffix."""
    folder = shared_data / "interop" / "metalsplatter" / "SplatIO" / "TestData"
    return lambda kind: folder / f"test-splat.3-points-from-train.{kind}"


@pytest.fixture
def minimal(shared_data):
    """Four Gaussians of degree 0 in several formats."""
    return shared_data / "interop" / "splat-transform" / "test" / "fixtures" / "splat"


def test_one_scene_as_ply_and_spz_agrees_within_the_steps_of_spz(points):
    # made by Niantic's program, which turns the axes and does not say so
    ply, spz = read_ply(points("ply")), load_spz(points("spz"), axes="rub").splats
    assert greatest(ply.means, spz.means) <= 0.5 / 4096 + 1e-7
    assert greatest(ply.log_scales, spz.log_scales) <= 0.5 / 16 + 1e-6
    assert greatest(ply.opacities, spz.opacities) <= 0.5 / 255 + 1e-6
    assert greatest(ply.sh_dc, spz.sh_dc) <= 0.5 / 255 / 0.15 + 1e-6
    assert rotation_error(ply, spz) <= 3 * 0.5 * np.sqrt(0.5) / 511
    # This writer keeps 5 bits of degree 1 and 4 of the others; wrong signs would be off by 0.2.
    assert spz.sh_degree == ply.sh_degree == 3
    assert ply.sh_rest.abs().max() > 0.1
    assert greatest(ply.sh_rest[:, :3], spz.sh_rest[:, :3]) <= 4.5 / 128
    assert greatest(ply.sh_rest[:, 3:], spz.sh_rest[:, 3:]) <= 8.5 / 128


def test_one_scene_as_ply_and_splat_agrees_within_the_steps_of_splat(points):
    ply, splat = read_ply(points("ply")), FORMAT.read(points("splat"))
    assert torch.equal(splat.means, ply.means)
    assert greatest(splat.log_scales, ply.log_scales) <= 1e-5
    # This writer cuts off where others round: up to a whole step.
    assert greatest(splat.opacities, ply.opacities) <= 1 / 255 + 1e-6
    assert greatest(SH_C0 * splat.sh_dc, SH_C0 * ply.sh_dc) <= 1 / 255 + 1e-6
    assert rotation_error(splat, ply) <= 1.5 / 128
    assert splat.sh_degree == 0


def test_a_file_without_gzip_is_the_one_with_it(minimal):
    packed, raw = (load_spz(minimal / f"minimal-{name}.spz").splats for name in ("v2", "raw"))
    for name, value in packed.parameters().items():
        assert torch.equal(value, getattr(raw, name)), name


def test_four_points_on_a_square_are_one_scene_in_every_version(minimal):
    splat = FORMAT.read(minimal / "minimal.splat")
    assert splat.means.tolist() == [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]]
    for version in (3, 4):
        spz = load_spz(minimal / f"minimal-v{version}.spz", axes="rub").splats
        assert torch.equal(spz.means, splat.means)
        assert spz.quats.tolist() == [[1, 0, 0, 0]] * 4
        assert greatest(spz.log_scales, splat.log_scales) <= 0.5 / 16
        assert torch.equal(spz.logit_opacities, splat.logit_opacities)
    two = load_spz(minimal / "minimal-v2.spz").splats  # made without turning the axes
    assert torch.equal(two.means, splat.means)
    assert rotation_error(two, spz) <= 0.5 / 127.5 + 1e-6


@pytest.fixture
def biker(shared_data):
    return shared_data / "interop" / "playcanvas-engine"


def test_a_scene_of_150_thousand_agrees_as_spz_and_compressed_ply(biker):
    spz = load_spz(biker / "biker.spz", axes="rub").splats  # which the file does not name
    ply = load_compressed_ply(biker / "biker.compressed.ply").splats
    assert len(spz) == len(ply) == 152746
    # SPZ was made of the compressed .ply: its half steps are all the difference.
    assert greatest(spz.means, ply.means) <= 0.5 / 4096 + 1e-6
    assert greatest(spz.log_scales, ply.log_scales.clamp(min=-10)) <= 0.5 / 16 + 1e-6
    assert torch.equal(spz.opacities, ply.opacities)
    assert greatest(spz.sh_dc, ply.sh_dc.clamp(-0.5 / 0.15, 0.5 / 0.15)) <= 0.5 / 255 / 0.15 + 1e-5
    assert rotation_error(spz, ply) <= 3 * 0.5 * np.sqrt(0.5) / 511 + 1e-5


def test_larger_files_of_other_programs_are_read(shared_data, biker):
    guitar = load_compressed_ply(biker / "guitar.compressed.ply").splats
    assert (len(guitar), guitar.sh_degree) == (90854, 0)
    model = FORMAT.read(shared_data / "interop" / "splat-viewer" / "model.splat")
    assert len(model) == 124495
    for splats in (guitar, model):
        assert (splats.quats.norm(dim=1) - 1).abs().max() < 0.02
        assert splats.log_scales.max() < 5
