"""The model in the world frame, and its frames without lens distortion.

Originals and denoised twins get the same pinhole camera. COLMAP scales it so that no pixel of the
result lies outside the frame (blank_pixels = 0): a model learns no black borders.
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

from recon_cli.io.colmap import Pinhole
from recon_cli.io.records import read_poses
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.align_world import ScaleBetween, world_transform
from recon_cli.sfm.job import MappingJob, Reporter, Result, fresh_folder, publish
from recon_cli.workspace import atomic
from recon_cli.workspace.summaries import WorldSummary

IMAGES, TWINS, SPARSE, MASKS = "images", "denoised", "sparse", "masks"


def place_model(job: MappingJob) -> Result:
    """Writes the mapper's model, moved into the world frame, into out/sparse.

    The axes of a data set with poses are left as they are. Returns a `WorldSummary` as JSON values;
    ConfigError if a place of --scale-between is unknown.
    """
    model = pycolmap.Reconstruction(job.model)
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    world = world_transform(
        np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3),
        {name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
         for name, image in images.items()},
        gravity=job.gravity and not job.known_poses,
        scale_between=ScaleBetween(*job.scale_between) if job.scale_between else None,
        metric=job.known_poses and job.poses is not None and read_poses(job.poses).metric,
        pinholes={name: _pinhole(image.camera) for name, image in images.items()})
    move_model(model, world.similarity)
    folder = fresh_folder(job.out / "sparse.partial")
    model.write(folder)
    publish(folder, job.out / "sparse")
    summary = world.summary().to_json()
    atomic.write_json(job.out / WorldSummary.FILE, summary)
    return summary


def move_model(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Moves cameras and points of `model`; each observation keeps its reprojection error."""
    model.transform(pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _pinhole(camera: pycolmap.Camera) -> Pinhole:
    """Returns the camera of the undistorted image, to whose pixels --scale-between may point."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    return Pinhole(flat.width, flat.height, *flat.params)


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
    flat = pycolmap.Reconstruction(work / SPARSE)
    counts = Counter(flat.image(i).camera_id for i in flat.reg_image_ids())
    cameras = [
        {"width": camera.width, "height": camera.height, "focal_px": camera.mean_focal_length(),
         "frames": counts[index]}
        for index, camera in sorted(flat.cameras.items())]
    publish(work, job.out / "undistorted")
    return {"cameras": cameras}


def _write_twins(job: MappingJob, names: Sequence[str], work: Path) -> None:
    """Writes the denoised twins; those of unchanged frames are copies, byte by byte."""
    changed = [
        name for name in names
        if not filecmp.cmp(job.frames / name, job.denoised / name, shallow=False)]
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
    """Writes the undistorted masks of masked frames: 255 where most of a pixel counts."""
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
