"""Cameras and points from the matches, by COLMAP's incremental and its global mapper."""

from __future__ import annotations

import itertools
import shutil
from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.scene.statistics import OUTLIER_SIGMAS
from recon_cli.sfm import database
from recon_cli.sfm.job import MappingJob, Reporter, fresh_folder
from recon_cli.sfm.limits import (
    LOSS_SCALE,
    MAX_ERROR_PX,
    MIN_FRAMES,
    MIN_IMAGES_PRINCIPAL,
    MIN_RAY_ANGLE_DEG,
    RELAXED_POSE_INLIERS,
    RELAXED_POSE_SHARE,
)

# Threads add sums in any order; one gives the same bytes every time, for 5% more time on two cores.
THREADS = 1
# Growth after which all is adjusted again: 16.2 s on the sample, 20.0 s with COLMAP's 1.1.
GLOBAL_RATIO = 1.2
# Relative change of the cost that ends an adjustment; a hundredth takes three times as long and
# moves those cameras by less than .001 cm.
TOLERANCE = 1e-4
# Images up to which an adjustment is solved directly; COLMAP takes conjugate gradients from 1,000
# on. The last adjustment of 1,200 frames took 125 s for 272 s, and ended nearer to the truth.
MAX_DIRECT = 3000
KEPT_SHARE = 0.5  # of the points of every image
# Where COLMAP writes models that are read from memory, and finds the one that it continues.
MODELS, START = "found.partial", "begun.partial"


def map_incrementally(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns every model that the incremental mapper finds, adjusted; they may share images."""
    return _map(job, report, _options(job))


def map_relaxed(
    job: MappingJob, report: Reporter, names: Sequence[str] = ()
) -> list[pycolmap.Reconstruction]:
    """Returns the models with lower thresholds for the first pair and each further image.

    `names` are the only images that are mapped, where there are some.
    """
    options = _options(job)
    options.image_names = list(names)
    _relax(options)
    return _map(job, report, options)


def _map(
    job: MappingJob, report: Reporter, options: pycolmap.IncrementalPipelineOptions
) -> list[pycolmap.Reconstruction]:
    images = itertools.count(3)  # the first call comes with the third image of a model
    report.phase("mapping", len(job.names))
    models = pycolmap.incremental_mapping(
        job.database, job.frames, fresh_folder(job.attempts / MODELS), options,
        next_image_callback=lambda: report.done(min(next(images), len(job.names))))
    shutil.rmtree(job.attempts / MODELS)
    return _adjusted(models)


def _adjusted(models: Mapping[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    for model in models.values():
        adjust(model)
    return list(models.values())


def extend_model(
    job: MappingJob, model: pycolmap.Reconstruction, rounds: int | None = None
) -> pycolmap.Reconstruction:
    """Returns a model with the images that the mapper can add to it, adjusted as a whole.

    `rounds` is the most adjustments with new points in between after the last image, COLMAP's if
    not given.
    """
    start, options = fresh_folder(job.attempts / START), _options(job)
    write_model(model, start)
    if rounds is not None:
        options.ba_global_max_refinements = rounds
    options.multiple_models = False
    models = pycolmap.incremental_mapping(
        job.database, job.frames, fresh_folder(job.attempts / MODELS), options, input_path=start)
    shutil.rmtree(start)
    shutil.rmtree(job.attempts / MODELS)
    return max(models.values(), key=model_size, default=model)


def resect(job: MappingJob, model: pycolmap.Reconstruction) -> int:
    """Adds the images to a model, in place, that its points place; returns how many.

    Nothing else is adjusted. Images are taken in the order of their names.
    """
    with pycolmap.Database.open(job.database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
    options = _options(job)
    worker = pycolmap.IncrementalMapper(cache)
    worker.begin_reconstruction(model)
    placed = 0
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if not image.has_pose and worker.register_next_image(options.mapper, image.image_id):
            worker.triangulate_image(options.triangulation, image.image_id)
            placed += 1
    worker.end_reconstruction(False)
    return placed


def map_globally(job: MappingJob, report: Reporter) -> list[pycolmap.Reconstruction]:
    """Returns the models of the global mapper, which places all images at once, adjusted.

    Unknown focal lengths are estimated from the matches first, in a copy of the database.
    """
    report.phase("mapping", len(job.names))
    copy = job.attempts / "global.db"
    job.attempts.mkdir(exist_ok=True)
    database.remove(copy)
    shutil.copyfile(job.database, copy)
    if any(group.lens is None and group.focal_px is None for group in job.groups):
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = job.seed
        pycolmap.calibrate_view_graph(copy, calibration)
    models = pycolmap.global_mapping(
        copy, job.frames, fresh_folder(job.attempts / MODELS), _global_options(job))
    shutil.rmtree(job.attempts / MODELS)
    database.remove(copy)
    return _adjusted(models)


def adjust(
    model: pycolmap.Reconstruction, *, constant: Collection[int] = (), loss_scale: float = 0.0
) -> None:
    """Adjusts a model in place with the principal point free; drops points that got lost.

    All images together determine it: on the fox photos it comes out 2 px from the published value,
    16 px off the middle. The intrinsics of the cameras `constant` stay as they are. Errors count
    squared, or by Cauchy's loss from `loss_scale` pixels on.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.num_threads = THREADS
    options.ceres.solver_options.function_tolerance = TOLERANCE
    options.ceres.max_num_images_direct_sparse_cpu_solver = MAX_DIRECT
    if loss_scale:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = loss_scale
    # Taking images out of a model leaves points with a single ray, which COLMAP cannot adjust.
    for number in [number for number, point in model.points3D.items() if point.track.length() < 2]:
        model.delete_point3D(number)
    fixed = {*constant, *_rare_cameras(model)}
    if fixed:
        _adjust_some(model, options, fixed)
    else:
        pycolmap.bundle_adjustment(model, options)
    # Nothing holds a point whose rays went parallel: one of 2,084 ended 1e153 away.
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR_PX, MIN_RAY_ANGLE_DEG)
    model.update_point_3d_errors()


def adjust_points(model: pycolmap.Reconstruction) -> None:
    """Adjusts the points of a model in place, by its cameras as they are."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = THREADS
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
        config.set_constant_rig_from_world_pose(model.image(number).frame_id)
    for camera in model.cameras:
        config.set_constant_cam_intrinsics(camera)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def refine(
    job: MappingJob, model: pycolmap.Reconstruction, rounds: int | None = None
) -> None:
    """Adjusts a model in place, and completes, merges and filters its points, until it settles.

    `rounds` as for `extend_model`.
    """
    with pycolmap.Database.open(job.database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
    options = _options(job)
    adjustment = options.get_global_bundle_adjustment()
    adjustment.refine_principal_point = True
    adjustment.ceres.max_num_images_direct_sparse_cpu_solver = MAX_DIRECT
    worker = pycolmap.IncrementalMapper(cache)
    worker.begin_reconstruction(model)
    worker.iterative_global_refinement(
        options.ba_global_max_refinements if rounds is None else rounds,
        options.ba_global_max_refinement_change,
        options.mapper, adjustment, options.triangulation)
    worker.end_reconstruction(False)


def sharpen(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Returns an adjusted model, adjusted again to its exact observations.

    COLMAP's 4 pixels keep wrong matches, and squared errors give those the most weight. Errors
    count by Cauchy's loss here, and those far above the mean not at all, but in an image that
    would lose most of its points.
    """
    error = model.compute_mean_reprojection_error()
    sharp = pycolmap.Reconstruction(model)
    # half and twice as much change the error of the cameras by .02 cm; see LOSS_SCALE
    pycolmap.ObservationManager(sharp).filter_all_points3D(
        OUTLIER_SIGMAS * error, MIN_RAY_ANGLE_DEG)
    if any(sharp.image(i).num_points3D < KEPT_SHARE * model.image(i).num_points3D
           for i in model.reg_image_ids()):
        sharp = pycolmap.Reconstruction(model)
    adjust(sharp, loss_scale=LOSS_SCALE * error)
    return sharp


def triangulate(
    job: MappingJob, model: pycolmap.Reconstruction, *, refine_intrinsics: bool = False,
    rounds: int | None = None,
) -> pycolmap.Reconstruction:
    """Returns a model of the same poses with the points that the matches give.

    `rounds` is the most adjustments of the points, COLMAP's if not given; where the poses are
    adjusted next, one is enough.
    """
    options = _options(job)
    if rounds is not None:
        options.ba_global_max_refinements = rounds
    triangulated = pycolmap.triangulate_points(
        model, job.database, job.frames, fresh_folder(job.attempts / MODELS), True, options,
        refine_intrinsics)
    shutil.rmtree(job.attempts / MODELS)
    return triangulated


def list_registered(model: pycolmap.Reconstruction) -> list[str]:
    """Returns the names of the images that have a camera, sorted."""
    return sorted(model.image(i).name for i in model.reg_image_ids())


def triangulation_angles(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """Returns the widest angle between two rays to each point, [P], degrees."""
    centers = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    points = list(model.points3D.values())
    places = np.array([point.xyz for point in points]).reshape(-1, 3)
    lengths = np.array([point.track.length() for point in points], np.int64)
    seen_from = np.array([
        centers[element.image_id] for point in points for element in point.track.elements])
    rays = seen_from.reshape(-1, 3) - np.repeat(places, lengths, axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    start = np.cumsum(lengths) - lengths
    angles = np.empty(len(points))
    for length in np.unique(lengths):
        own = np.flatnonzero(lengths == length)
        each = rays[start[own][:, None] + np.arange(length)]  # [points of this length, length, 3]
        angles[own] = np.arccos(np.clip((each @ each.transpose(0, 2, 1)).min(axis=(1, 2)), -1, 1))
    return np.degrees(angles)


def model_size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """Returns the number of images that have a camera, and of points."""
    return model.num_reg_images(), model.num_points3D()


def _options(job: MappingJob) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = THREADS
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = job.seed
    options.min_model_size = MIN_FRAMES  # COLMAP's 10 would drop small captures
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GLOBAL_RATIO
    options.ba_global_function_tolerance = TOLERANCE
    if job.panoramas:  # they see parallax to their sides, however they move
        options.mapper.init_max_forward_motion = 1.0
        options.triangulation.ignore_two_view_tracks = False
    return options


def _relax(options: pycolmap.IncrementalPipelineOptions) -> None:
    """Halves COLMAP's thresholds for the first pair and each further image, and tries more often.

    The angle of the first pair falls to a quarter, which COLMAP itself tries last for a capture
    with short steps. A fast turn past a bare wall leaves points of small angles alone.
    """
    mapper = options.mapper
    mapper.filter_min_tri_angle = options.triangulation.min_angle = MIN_RAY_ANGLE_DEG / 2
    mapper.init_min_num_inliers = 50  # of 100
    mapper.init_min_tri_angle = 4.0  # of 16 degrees
    mapper.abs_pose_min_num_inliers = RELAXED_POSE_INLIERS
    mapper.abs_pose_min_inlier_ratio = RELAXED_POSE_SHARE
    mapper.max_reg_trials = 6  # of 3
    options.init_num_trials = 400  # of 200


def _global_options(job: MappingJob) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions()
    mapper = options.mapper
    options.min_model_size = MIN_FRAMES
    options.num_threads = mapper.num_threads = THREADS
    mapper.bundle_adjustment.ceres.solver_options.num_threads = THREADS
    options.random_seed = mapper.random_seed = job.seed
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = job.seed
    mapper.retriangulation.random_seed = job.seed
    if job.panoramas:
        mapper.track_min_num_views_per_track = 2
        mapper.retriangulation.ignore_two_view_tracks = False
    return options


def _rare_cameras(model: pycolmap.Reconstruction) -> set[int]:
    """Returns the cameras with few images, where there are several."""
    if len(model.cameras) == 1:
        return set()
    counts = Counter(model.image(image).camera_id for image in model.reg_image_ids())
    return {camera for camera in model.cameras if counts[camera] < MIN_IMAGES_PRINCIPAL}


def _adjust_some(
    model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions, fixed: set[int]
) -> None:
    """Adjusts a model in which the intrinsics of some cameras stay as they are."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    for camera in fixed:
        config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
