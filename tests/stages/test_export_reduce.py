"""export takes away what it is asked to, and says what that costs."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace

import pytest
import torch
from facts import assert_facts, raises
from tiny_stages import CONTEXT, LEARNT, run_export

from recon_cli.cli import main
from recon_cli.config.export import ExportConfig
from recon_cli.errors import ConfigError
from recon_cli.export.reduce import crop, fit_to_size
from recon_cli.export.verify import load_reference_psnr
from recon_cli.io.training_scene import load_scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import SH_C0
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.registry import FORMATS
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.records import ImportRecord


@pytest.fixture
def inputs(tiny_learnt):
    """A short training of the tiny scene, with harmonics."""
    return tiny_learnt


@pytest.fixture
def whole(inputs):
    """The trained scene."""
    return read_ply(inputs.folders["train"] / "splats.ply")


def exported(inputs, out, **options):
    return run_export(ExportConfig(**options), inputs, out, CONTEXT)


def test_a_crop_keeps_the_centres_in_the_box_and_says_what_went(inputs, whole, tmp_path, caplog):
    caplog.set_level(logging.INFO, "recon")
    middle = whole.means.median(dim=0).values
    box = (-1e3, -1e3, -1e3, float(middle[0]), 1e3, 1e3)
    summary = exported(inputs, tmp_path, crop=box)
    kept = whole.means[whole.means[:, 0] <= middle[0]]
    assert torch.equal(read_ply(tmp_path / "splats.ply").means, kept)
    (change,) = summary.changes
    file = len(whole.with_sphere())
    assert (change.gaussians, change.gaussians_before) == (len(kept), file)
    assert change.psnr_change_db < -0.5  # half of the scene is gone
    assert_facts(caplog.text, "crop", f"{len(kept)} of {file:,}")


def test_without_its_backdrop_a_scene_is_on_black_and_the_loss_is_said(inputs, whole, tmp_path):
    assert whole.backdrop is not None
    summary = exported(inputs, tmp_path, backdrop="drop", format="spz")
    back = read_ply(tmp_path / "splats.ply")
    assert back.backdrop is None
    assert torch.equal(back.means, whole.means)
    assert len(FORMATS["spz"].read(tmp_path / "splats.spz")) == len(whole)
    (change,) = summary.changes
    assert (change.option, change.gaussians) == ("backdrop", len(whole))
    scene = load_scene(inputs.folders, validation=LEARNT.validation)
    psnr = load_reference_psnr(scene, Similarity(), LEARNT.max_size, CONTEXT)
    assert change.psnr_change_db == pytest.approx(
        psnr.psnr_db(back) - psnr.psnr_db(whole), abs=1e-3)


@pytest.mark.integration
def test_files_are_bounded_but_the_page_and_what_is_kept(inputs, whole, tmp_path):
    far = replace(whole, means=whole.means.clone())
    row = int(far.means.norm(dim=1).argmax())
    far.means[row] *= 1000 / far.means[row].norm()
    folder = tmp_path / "train"
    shutil.copytree(inputs.folders["train"], folder)
    write_ply(folder / "splats.ply", far)
    inputs = replace(inputs, folders={**inputs.folders, "train": folder})
    for name in ("bounded", "kept"):
        (tmp_path / name).mkdir()
    summary = exported(inputs, tmp_path / "bounded", format="glb,html")
    files = {name: FORMATS[name].read(tmp_path / "bounded" / f"splats.{name}")
             for name in ("ply", "glb", "html")}
    for name in ("ply", "glb"):
        assert files[name].means.abs().max() < 100
        assert len(files[name]) == summary.gaussians
    assert files["html"].means.abs().max() > 900
    assert [change.option for change in summary.changes] == ["backdrop"]
    assert summary.changes[0].gaussians == summary.gaussians
    kept = exported(inputs, tmp_path / "kept", backdrop="keep")
    assert torch.equal(read_ply(tmp_path / "kept" / "splats.ply").means, far.means)
    assert kept.gaussians == len(far.with_sphere())
    assert kept.changes is None
    ImportRecord("a.ply", "ply", "", len(far), 3, True, True, doubt="it may not fit").write(folder)
    (tmp_path / "doubted").mkdir()
    exported(inputs, tmp_path / "doubted")  # its room is not known
    assert torch.equal(read_ply(tmp_path / "doubted" / "splats.ply").means, far.means)


def test_the_old_spelling_of_the_backdrop_says_what_to_write(tmp_path, capsys):
    assert main(["export", "--drop-backdrop", "-w", str(tmp_path)]) == 2
    assert "--backdrop drop" in capsys.readouterr().err
    config = tmp_path / "old.toml"
    config.write_text("[export]\ndrop_backdrop = false\n")
    assert main(["export", "--config", str(config), "--print-config", "-w", str(tmp_path)]) == 0
    capsys.readouterr()
    config.write_text("[export]\ndrop_backdrop = true\n")
    assert main(["export", "--config", str(config), "-w", str(tmp_path)]) == 2
    assert "--backdrop drop" in capsys.readouterr().err


def test_a_crop_is_in_units_of_the_exported_scene(inputs, whole, tmp_path):
    scaled = exported(inputs, tmp_path, scale_between=("000000.png", "000006.png", 7.0))
    scale = scaled.transform["scale"]
    middle = float(scale * whole.means[:, 0].median())
    exported(inputs, tmp_path, scale_between=("000000.png", "000006.png", 7.0),
             crop=(-1e6, -1e6, -1e6, middle * (1 + 1e-6), 1e6, 1e6))
    assert len(read_ply(tmp_path / "splats.ply")) == -(-len(whole) // 2)


def test_a_box_without_gaussians_is_refused_with_where_they_are(whole):
    with raises(ConfigError, "Gaussian", "centre") as caught:
        crop(whole, (1e5, 1e5, 1e5, 2e5, 2e5, 2e5))
    corners = (whole.means.quantile(share, dim=0).tolist() for share in (0.05, 0.95))
    assert_facts(caught.value.hint, *(" ".join(f"{side:.2f}" for side in one) for one in corners))
    with raises(ConfigError, "lowest", "highest"):
        ExportConfig(crop=(1.0, 0.0, 0.0, 0.0, 1.0, 1.0))


def test_a_lower_degree_keeps_the_colours_that_the_views_see(inputs, whole, tmp_path):
    summary = exported(inputs, tmp_path, sh_degree=1, backdrop="keep")
    back = read_ply(tmp_path / "splats.ply")
    assert back.sh_degree == 1
    (change,) = summary.changes
    assert (change.degree, change.degree_before) == (1, 3)
    scene = load_scene(inputs.folders, validation=LEARNT.validation)
    psnr = load_reference_psnr(scene, Similarity(), LEARNT.max_size, CONTEXT)
    cut = psnr.psnr_db(whole.with_degree(1)) - psnr.psnr_db(whole)
    assert cut < change.psnr_change_db - 0.1


def test_a_file_without_harmonics_has_the_colours_that_the_views_see(inputs, whole, tmp_path):
    exported(inputs, tmp_path, format="splat", backdrop="drop")
    exported(inputs, tmp_path, format="ply", sh_degree=0)
    back = FORMATS["splat"].read(tmp_path / "splats.splat")
    fitted = read_ply(tmp_path / "splats.ply")
    assert not torch.equal(fitted.sh_dc, whole.sh_dc)
    assert torch.allclose(  # .splat has another order
        back.sh_dc.sort(0).values, fitted.sh_dc.sort(0).values.clamp(-0.5 / SH_C0, 0.5 / SH_C0),
        atol=0.5 / 255 / SH_C0 + 1e-3)


def test_a_palette_that_loses_too_much_gets_more_entries(inputs, tmp_path):
    alone = {"format": "sog", "backdrop": "drop"}
    small = exported(inputs, tmp_path, **alone, max_loss=9.0).files["sog"]
    allowed = -0.7 * small.psnr_change_db
    large = exported(inputs, tmp_path, **alone, max_loss=allowed).files["sog"]
    assert small.psnr_change_db < -allowed <= large.psnr_change_db
    assert large.bytes > small.bytes


@pytest.mark.integration
@pytest.mark.parametrize("name", ["ply", "spz", "sog"])
def test_a_file_is_no_larger_than_asked_for(inputs, whole, tmp_path, name):
    exported(inputs, tmp_path, format=name, backdrop="drop")
    path = tmp_path / EXPORT_FORMATS[name].file
    most = 0.6 * path.stat().st_size / 1e6
    summary = exported(inputs, tmp_path, format=name, max_mb=most, backdrop="drop")
    assert path.stat().st_size <= 1e6 * most
    _, change = summary.changes
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
        fewer=lambda splats, count: splats.select(torch.arange(len(splats) - count, len(splats))),
        at_degree=whole.with_degree, psnr_db=psnr_db)
    assert best.sh_degree == 1
    assert [degree for degree, _ in asked] == [3, 2, 1, 0]
    counts = [count for _, count in asked]
    assert counts == sorted(counts)  # fewer coefficients leave room for more Gaussians
    assert torch.equal(best.means, whole.means[-len(best):])  # those of the highest scores



def test_a_limit_that_is_met_anyway_changes_nothing(inputs, whole, tmp_path):
    summary = exported(inputs, tmp_path, max_mb=100.0)
    assert summary.changes[0].gaussians == len(whole)
    assert torch.equal(read_ply(tmp_path / "splats.ply").means, whole.means)
