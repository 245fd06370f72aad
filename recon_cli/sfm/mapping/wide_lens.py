"""Fisheye lenses: found by the matches, and mapped as such.

The model of ordinary lenses bends far enough to place the pictures of a fisheye, but wrongly: 155
degrees across were mapped with all images, small errors and centres 9 cm off in a room. The
epipolar geometry of pairs decides before anything is mapped: the matches are counted that one
motion explains, for fisheyes and for ordinary lenses without distortion of several focal lengths.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.matches import MIN_PAIR_INLIERS
from recon_cli.sfm import database
from recon_cli.sfm.features import matching
from recon_cli.sfm.job import DATABASE, CameraGroup, MappingJob, Reporter
from recon_cli.sfm.limits import EXACT_PX
from recon_cli.sfm.mapping import mapper

# The fallbacks, which have databases of their own: for fisheyes, and for what errors of points show
ATTEMPT, OTHER = "fisheye", "lens"
FISHEYE, ORDINARY = "OPENCV_FISHEYE", "SIMPLE_PINHOLE"
# Focal lengths that are tried, in longer sides of the image; mapping corrects the rest. Of a
# fisheye: from 180 degrees across the shorter side to about 75 across the longer one.
FOCALS = tuple(0.22 * 1.2**step for step in reversed(range(7)))
ORDINARY_FOCALS = (0.72, 0.5, 1.04)  # the most usual first: others end sooner
# How many times as many matches a fisheye must explain as an ordinary lens. In the room `office` a
# fisheye of 155 degrees explains 1.19 times as many and one of 104 degrees 1.06 times; for the
# ordinary lenses of 17 captures it was 0.83 to 1.00.
CLEARLY = 1.03
_PAIRS = 16  # of the most matches, that the lenses are tried on
_LEAST_MATCHES = 500  # in those pairs; fewer decide nothing
_TRIALS = (50, 300)  # of RANSAC, least and most

Sample = tuple[NDArray[np.float64], NDArray[np.float64]]  # pixels [M, 2] of matches in two images


def find_fisheyes(job: MappingJob) -> dict[int, float]:
    """Returns the focal lengths in pixels of cameras that are fisheyes, by their numbers.

    These are the cameras that --camera-model calls so, and those whose matches show it clearly.
    """
    unknown = {number: group for number, group in enumerate(job.groups, start=1)
               if group.lens is None and (group.model == "auto" or "FISHEYE" in group.model)}
    if not unknown or job.known_poses:
        return {}
    samples, found = _read_samples(job), {}
    for number, group in unknown.items():
        focal = _find_focal(group, samples.get(number, []), seed=job.seed)
        if focal is not None:
            found[number] = focal
    return found


def _find_focal(
    group: CameraGroup, samples: list[Sample], *, seed: int
) -> float | None:
    """Returns the focal length in pixels of a fisheye; None where it is an ordinary lens."""
    side, named = max(group.width, group.height), group.model != "auto"
    if sum(len(ours) for ours, _ in samples) < _LEAST_MATCHES and not named:
        return None

    def most(model: str, shares: tuple[float, ...], least: float) -> tuple[float, float | None]:
        focal = None
        for share in shares:
            count = _count_above(least, _camera(group, model, share * side), samples, seed=seed)
            if count is not None:
                least, focal = count, share * side
        return least, focal

    ordinary = -1.0 if named else CLEARLY * most(ORDINARY, ORDINARY_FOCALS, 0)[0]
    return most(FISHEYE, FOCALS, ordinary)[1]


def _count_above(
    least: float, camera: pycolmap.Camera, samples: list[Sample], *, seed: int
) -> int | None:
    """Returns how many matches a camera explains; None as soon as these can be no more than least.

    That is where it would take more of the pairs to come than there are matches in them.
    """
    count, rest = 0, sum(len(ours) for ours, _ in samples)
    for sample in samples:
        if count + rest <= least:
            return None
        count += count_explained(camera, sample, seed=seed)
        rest -= len(sample[0])
    return count if count > least else None


def map_fisheye(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the models of a capture with its fisheyes as such.

    The matches in the database of the features are verified anew, into the job's own. Where the
    incremental mapper finds no start, or less than half of the images, the global one is asked.
    """
    database.remove(job.database)
    shutil.copyfile(job.out / DATABASE, job.database)
    pairs = database.pair_names(job.database)
    fisheyes = find_fisheyes(job)
    with pycolmap.Database.open(job.database) as opened:
        for number, focal in fisheyes.items():
            opened.update_camera(_camera(job.groups[number - 1], FISHEYE, focal, number))
        for number in set(job.unknown_lenses) - fisheyes.keys():
            _rename(opened, number, job.groups[number - 1].model)
        opened.clear_two_view_geometries()
    matching.verify_pairs(job, pairs)
    models = mapper.map_incrementally(job, report)
    if max((model.num_reg_images() for model in models), default=0) < len(job.names) / 2:
        models += mapper.map_globally(job, report)
    return models


def map_lenses(
    job: MappingJob, report: Reporter, models: Mapping[int, str]
) -> list[pycolmap.Reconstruction]:
    """Returns the models of a capture with other camera models, by the numbers of the cameras."""
    groups = tuple(replace(group, model=models.get(number, group.model))
                   for number, group in enumerate(job.groups, 1))
    return map_fisheye(replace(job, groups=groups), report)


def _rename(opened: pycolmap.Database, number: int, model: str) -> None:
    """Gives a camera in a database another model, without distortion, if one is named."""
    known = opened.read_camera(number)
    if model in ("auto", known.model_name):
        return
    camera = pycolmap.Camera.create_from_model_name(
        number, model, known.mean_focal_length(), known.width, known.height)
    camera.has_prior_focal_length = known.has_prior_focal_length
    opened.update_camera(camera)


def _camera(
    group: CameraGroup, model: str, focal_px: float, number: int = 1
) -> pycolmap.Camera:
    """Returns an undistorted camera of a group, of the fisheye that --camera-model names if so."""
    if model == FISHEYE and group.model != "auto":
        model = group.model
    camera = pycolmap.Camera.create_from_model_name(
        number, model, focal_px, group.width, group.height)
    camera.has_prior_focal_length = True
    return camera


def count_explained(camera: pycolmap.Camera, sample: Sample, *, seed: int) -> int:
    """Returns how many matches between two images of a camera one motion explains."""
    options = pycolmap.RANSACOptions()
    options.random_seed = seed
    options.min_num_trials, options.max_num_trials = _TRIALS
    options.max_error = EXACT_PX
    found = pycolmap.estimate_essential_matrix(*sample, camera, camera, options)
    return 0 if found is None else int(found["num_inliers"])


def _read_samples(job: MappingJob) -> dict[int, list[Sample]]:
    """Returns the pairs of the most matches between images of each camera, by its number."""
    samples: dict[int, list[Sample]] = {}
    with pycolmap.Database.open(job.database) as opened:
        cameras = {image.image_id: image.camera_id for image in opened.read_all_images()}
        found = [(pycolmap.pair_id_to_image_pair(number), matches)
                 for number, matches in zip(*opened.read_all_matches(), strict=True)]
        points = {image: np.asarray(opened.read_keypoints(image))[:, :2].astype(np.float64)
                  for image in cameras}
    for (first, second), matches in sorted(found, key=lambda pair: (-len(pair[1]), pair[0])):
        own = samples.setdefault(cameras[first], [])
        if cameras[first] == cameras[second] and (
                len(own) < _PAIRS and len(matches) >= MIN_PAIR_INLIERS):
            own.append((points[first][matches[:, 0]], points[second][matches[:, 1]]))
    return samples
