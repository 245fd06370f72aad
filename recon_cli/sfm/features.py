"""SIFT features of every frame; the frames of a group share one camera."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pycolmap

from recon_cli.errors import FormatError
from recon_cli.sfm import checks, database
from recon_cli.sfm.checks import listed
from recon_cli.sfm.job import CameraGroup, Job, Reporter
from recon_cli.sfm.step_log import Result

CAMERA_MODEL = "OPENCV"  # two focal lengths, two radial and two tangential terms


def extract(job: Job, report: Reporter) -> Result:
    """Fills the database with the features of all frames and returns how many there are.

    Images that an interrupted run has finished are kept.

    Raises:
        FormatError: a frame cannot be read.
        SfmError: too few frames hold any texture.
    """
    report.phase("features", len(job.names), done=database.progress(job.database, "features"))
    for group in job.groups:
        masked = [name for name in group.names if job.masks and (job.masks / name).exists()]
        # COLMAP takes no image that has no mask where it is given a folder of masks.
        for names, masks in (
            (masked, job.masks), (sorted(set(group.names).difference(masked)), None)
        ):
            if names:  # an empty list would mean all
                pycolmap.extract_features(
                    job.database, job.frames, names, pycolmap.CameraMode.SINGLE,
                    _reader(group, masks), _extraction(job), pycolmap.Device.cpu)
    database.keep_coarsest(job.database, job.max_features)
    counts = database.keypoint_counts(job.database)
    _check_readable(job, counts)
    checks.check_texture(counts)
    return {"rows": len(counts), "keypoints": sum(counts.values())}


def create_database(job: Job) -> None:
    """Writes a database that holds a camera a group and every image, whole or not at all.

    Their ids are given here, in the order of the names, because extraction in several threads
    would number the images as they happen to be finished.

    Raises:
        FormatError: frames cannot be read or differ in size.
    """
    temporary = job.database.with_suffix(".partial")
    database.remove(job.database)
    database.remove(temporary)
    pycolmap.Database.open(temporary).close()
    for group in job.groups:
        pycolmap.import_images(
            temporary, job.frames, pycolmap.CameraMode.SINGLE, list(group.names),
            _reader(group))
    with pycolmap.Database.open(temporary) as opened:
        names = {image.name for image in opened.read_all_images()}
    _check_readable(job, names)
    temporary.replace(job.database)


def _check_readable(job: Job, found: Collection[str]) -> None:
    missing = [name for name in job.names if name not in found]
    if missing:
        raise FormatError(
            f"{len(missing)} of {len(job.names)} frames cannot be read or differ from the first in "
            f"size: {listed(missing)}.",
            hint="Run `recon ingest --again`.")


def _reader(group: CameraGroup, masks: Path | None = None) -> pycolmap.ImageReaderOptions:
    options = pycolmap.ImageReaderOptions()
    options.camera_model = CAMERA_MODEL
    if masks is not None:
        options.mask_path = masks
    if group.lens is not None:
        options.camera_model = group.lens.model
        options.camera_params = ",".join(map(repr, group.lens.params))
    elif group.focal_px is not None:
        focal = group.focal_px
        options.camera_params = f"{focal},{focal},{group.width / 2},{group.height / 2},0,0,0,0"
    return options


def _extraction(job: Job) -> pycolmap.FeatureExtractionOptions:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = job.threads
    # No hard cap, hence `keep_coarsest`: COLMAP stops after the scale at which the count is
    # reached, and a keypoint with two orientations counts twice.
    options.sift.max_num_features = job.max_features
    return options
