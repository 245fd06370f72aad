"""Frames without lens distortion: originals and denoised twins, through the same pinhole camera.

COLMAP scales the camera so that no pixel of the result lies outside the frame (blank_pixels = 0):
there are no black borders that a model would learn.
"""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from recon_cli.mapping.job import Job
from recon_cli.mapping.ledger import Result, fresh_folder, publish
from recon_cli.mapping.protocol import Reporter

IMAGES, TWINS, SPARSE = "images", "denoised", "sparse"


def undistort(job: Job, report: Reporter) -> Result:
    """Writes out/undistorted/{images,denoised,sparse} and returns its one camera."""
    model = pycolmap.Reconstruction(job.out / "sparse")
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    report.phase("undistorted", 2 * len(names))
    work = fresh_folder(job.undistorting)
    _undistorted(job, job.frames, names, work)
    _write_twins(job, names, work)
    camera, = pycolmap.Reconstruction(work / SPARSE).cameras.values()
    publish(work, job.out / "undistorted")
    return {
        "width": camera.width,
        "height": camera.height,
        "focal_px": camera.mean_focal_length(),
    }


def _write_twins(job: Job, names: Sequence[str], work: Path) -> None:
    """Writes the twins; those of frames that were left as they are become copies, byte by byte."""
    changed = [
        name for name in names
        if not filecmp.cmp(job.frames / name, job.denoised / name, shallow=False)
    ]
    twins = work / TWINS
    twins.mkdir()
    if changed:  # an empty list would mean all
        _undistorted(job, job.denoised, changed, work / "twins")
        for name in changed:
            (work / "twins" / IMAGES / name).rename(twins / name)
        shutil.rmtree(work / "twins")
    for name in set(names).difference(changed):
        shutil.copyfile(work / IMAGES / name, twins / name)


def _undistorted(job: Job, source: Path, names: Sequence[str], target: Path) -> None:
    """Writes images/ and sparse/ into `target`, without COLMAP's stereo folder and scripts."""
    pycolmap.undistort_images(
        target, job.out / "sparse", source, list(names), num_threads=job.threads)
    shutil.rmtree(target / "stereo")
    for script in target.glob("run-colmap-*.sh"):
        script.unlink()
