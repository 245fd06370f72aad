"""The record of each exported file: what it was made of, and whether that is so still."""

import dataclasses

import numpy as np
import pytest

from recon_cli.config.export import ExportConfig
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.export_record import (
    CLEAN_DB,
    VERSION,
    ExportedFile,
    ExportSummary,
    FailedFormat,
    deciding_options,
    describe_changes,
    loss_limit,
    owns,
    skip_options,
)


def options(**changes):
    return dataclasses.asdict(ExportConfig(**changes))


def exported(**changes):
    """A summary of an export to spz and mesh.ply with the options `changes`."""
    files = {name: ExportedFile(
        file=path, psnr_change_db=loss,
        made_of={"version": VERSION, **deciding_options(name, options(**changes))})
        for name, path, loss in (("spz", "splats.spz", -0.1), ("mesh.ply", "mesh.ply", None))}
    return ExportSummary(
        model="base", file="splats.ply", gaussians=1, bytes=1, transform={}, files=files)


@pytest.mark.parametrize(("asked", "reason"), [
    ({}, None),
    ({"format": "spz"}, None),
    ({"format": "spz, mesh.ply"}, None),
    ({"format": "glb"}, "glb is not there yet"),
    ({"format": "spz", "spz_version": 2}, "splats.spz is stale: it was written with "
     "--spz-version 3"),
    ({"format": "mesh.ply", "spz_version": 2}, None),
    ({"format": "mesh.ply", "voxel": 0.1}, "mesh.ply is stale: it was written before --voxel 0.1"),
    ({"format": "spz", "voxel": 0.1}, None),
    ({"format": "spz", "max_loss": 0.05}, "splats.spz loses more than 0.05 dB"),
    ({"format": "spz", "max_loss": 0.2}, None),
    ({"format": "spz", "max_mb": 1.0}, "another format was first, which --max-mb limits"),
], ids=str)
def test_only_what_decides_on_a_file_makes_it_stale(asked, reason):
    found = exported().contradictions(options(**asked))
    assert found[:1] == (() if reason is None else (reason,))


def test_a_stale_file_and_one_that_failed_are_written_again():
    summary = exported()
    old = dataclasses.replace(summary.files["spz"], stale="it was changed by hand")
    summary = dataclasses.replace(
        summary, files={"spz": old}, failed={"glb": FailedFormat(message="No.", hint="Why?")})
    assert summary.contradictions(options(format="spz,glb")) == (
        "splats.spz is stale: it was changed by hand", "glb could not be written")
    assert summary.contradictions(options()) == ()
    error = summary.failure()
    assert (error.exit_code, error.message, error.hint) == (5, "No. Written: splats.ply.", "Why?")


def test_the_record_survives_its_file():
    summary = exported(crop=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0))
    back = ExportSummary.from_json(summary.to_json())
    assert back == summary
    assert back.contradictions(options(format="spz,mesh.ply")) == ()


@pytest.mark.parametrize(("before", "now", "reason"), [
    (None, {"version": 5}, "another version of recon wrote it"),
    ({"version": 4}, {"version": 5}, "another version of recon wrote it"),
    ({"train": "a"}, {"train": "b"}, "it was made from an earlier training"),
    ({"sfm": "a"}, {"sfm": "b"}, "it was made from earlier cameras"),
    ({"model": "base"}, {"model": "pruned"}, "it shows the base model"),
    ({"crop": None}, {"crop": [0.5, 1.0]}, "it was written before --crop 0.5 1"),
    ({"crop": [0.5, 1.0]}, {"crop": None}, "it was written with --crop 0.5 1"),
    ({"backdrop": "bounded"}, {"backdrop": "drop"}, "it was written with --backdrop bounded"),
    ({"up": "y"}, {"up": "-y"}, "it was written with --up y"),
    ({"transform": [1.0] * 16}, {"transform": None}, "it was written with --transform"),
    ({"limited": None}, {"limited": "spz"}, "--max-mb limited nothing"),
    ({"up": "y"}, {"up": "y"}, ""),
], ids=str)
def test_what_a_file_was_made_of_is_compared_in_words(before, now, reason):
    assert describe_changes(before, now) == reason


def test_each_format_has_files_of_its_own():
    paths = {"ply": "splats.ply", "spz": "splats.spz", "compressed.ply": "splats.compressed.ply",
             "lod": "lod/0_0/meta.json", "colmap": "sparse/0/images.bin", "plan.svg": "plan.svg",
             "transforms.json": "sparse_pc.ply", "mesh.glb": "mesh.glb", "points.ply": "points.ply"}
    for name, path in paths.items():
        assert [one for one in EXPORT_FORMATS if owns(one, path)] == [name]
    assert {one for one in EXPORT_FORMATS if owns(one, "images/a.png")} == {
        "colmap", "transforms.json"}


@pytest.mark.parametrize(("change_db", "psnr_db", "passes"), [
    (-0.2, 31.0, True), (-0.4, 31.0, False), (-0.4, 44.9, False), (-20.0, 45.1, True),
    (float("nan"), float("nan"), False)])
def test_a_loss_that_eight_bits_hide_passes_where_nobody_gave_a_limit(change_db, psnr_db, passes):
    assert loss_limit("spz", options()).allows(change_db, psnr_db) is passes
    given = loss_limit("spz", options(max_loss=0.3))
    assert given.allows(change_db, psnr_db) is (passes and change_db > -0.3)
    assert 10 * np.log10(12 * 255**2) > CLEAN_DB + 10  # rounding to 8 bits alone


def test_a_clean_file_is_fresh_whatever_it_lost_unless_a_limit_is_given():
    summary = exported()
    clean = dataclasses.replace(summary.files["spz"], psnr_change_db=-9.0, psnr_db=54.0)
    summary = dataclasses.replace(summary, files={"spz": clean})
    assert summary.contradictions(options(format="spz")) == ()
    assert summary.contradictions(options(format="spz", max_loss=1.0)) == (
        "splats.spz loses more than 1 dB",)
    unknown = dataclasses.replace(clean, psnr_db=None)  # written by an older version
    assert dataclasses.replace(summary, files={"spz": unknown}).contradictions(
        options(format="spz")) == ("splats.spz loses more than 0.3 dB",)


def test_a_format_that_was_left_out_as_allowed_is_not_missed_until_it_is_asked_for():
    allowed = options(format="html", skip_lossy=True)
    left_out = FailedFormat(
        message="It loses.", hint="", skipped_with=skip_options("html", allowed))
    summary = ExportSummary.from_json(dataclasses.replace(
        exported(), failed={"html": left_out}).to_json())
    assert summary.failure() is None
    assert summary.contradictions(allowed) == ()
    for changed in ({"skip_lossy": False}, {"max_loss": 3.0}, {"title": "Room"}):
        assert summary.contradictions({**allowed, **changed}) == ("html could not be written",)
