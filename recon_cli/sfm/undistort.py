"""Frames without lens distortion: originals and denoised twins, through the same pinhole camera.

COLMAP scales the camera so that no pixel of the result lies outside the frame (blank_pixels = 0):
there are no black borders that a model would learn.
"""

from __future__ import annotations

import filecmp
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from recon_cli.sfm.job import MappingJob, Reporter, Result, fresh_folder, publish

IMAGES, TWINS, SPARSE, MASKS = "images", "denoised", "sparse", "masks"


def undistort(job: MappingJob, report: Reporter) -> Result:
    """Writes out/undistorted/{images,denoised,sparse} and masks/, and returns its cameras."""
    model = pycolmap.Reconstruction(job.out / "sparse")
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    masked = [name for name in names if job.masks and (job.masks / name).exists()]
    report.phase("undistorted", 2 * len(names) + len(masked))
    work = fresh_folder(job.undistorting)
    _undistort(job, job.frames, names, work)
    _write_twins(job, names, work)
    _write_masks(job, masked, work)
    cameras = _cameras(pycolmap.Reconstruction(work / SPARSE))
    publish(work, job.out / "undistorted")
    return {"cameras": cameras}


def _cameras(model: pycolmap.Reconstruction) -> list[dict[str, float]]:
    """Returns width, height, focal length in pixels and frames of each camera, in its order."""
    used = Counter(model.image(i).camera_id for i in model.reg_image_ids())
    return [
        {"width": camera.width, "height": camera.height, "focal_px": camera.mean_focal_length(),
         "frames": used[index]}
        for index, camera in sorted(model.cameras.items())]


def _write_twins(job: MappingJob, names: Sequence[str], work: Path) -> None:
    """Writes the denoised twins; those of unchanged frames are copies, byte by byte."""
    changed = [
        name for name in names
        if not filecmp.cmp(job.frames / name, job.denoised / name, shallow=False)
    ]
    twins = work / TWINS
    twins.mkdir()
    if changed:  # an empty list would mean all
        _undistort(job, job.denoised, changed, work / "twins")
        for name in changed:
            (work / "twins" / IMAGES / name).rename(twins / name)
        shutil.rmtree(work / "twins")
    for name in set(names).difference(changed):
        shutil.copyfile(work / IMAGES / name, twins / name)


def _write_masks(job: MappingJob, masked: Sequence[str], work: Path) -> None:
    """Writes the masks of masked frames through the same cameras: 255 where a pixel counts.

    A pixel that mixes one that counts and one that does not takes the value of the larger part.
    """
    if job.masks is None or not masked:  # an empty list would mean all
        return
    (work / MASKS).mkdir()
    _undistort(job, job.masks, masked, work / "between")
    for name in masked:
        data = np.frombuffer((work / "between" / IMAGES / name).read_bytes(), np.uint8)
        gray = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
        _, packed = cv2.imencode(".png", np.where(gray < 128, 0, 255).astype(np.uint8))
        (work / MASKS / name).write_bytes(packed.tobytes())
    shutil.rmtree(work / "between")


def _undistort(job: MappingJob, source: Path, names: Sequence[str], target: Path) -> None:
    """Writes images/ and sparse/ into `target`, without COLMAP's stereo folder and scripts."""
    pycolmap.undistort_images(
        target, job.out / "sparse", source, list(names), num_threads=job.threads)
    shutil.rmtree(target / "stereo")
    for script in target.glob("run-colmap-*.sh"):
        script.unlink()
