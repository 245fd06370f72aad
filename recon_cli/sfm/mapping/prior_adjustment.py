"""Bundle adjustment that starts from tracked cameras and is held by where these were.

Matches say how the cameras lie to each other, the priors hold what no match says: the world frame,
its scale, and groups of cameras that share no point. COLMAP's adjuster takes positions alone, so
the cameras of a model turn with the positions of all.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.limits import LOSS_SCALE, MAX_ERROR_PX, MIN_RAY_ANGLE_DEG
from recon_cli.sfm.mapping.mapper import MAX_DIRECT, THREADS, TOLERANCE

Centers = Mapping[str, NDArray[np.float64]]  # [3] camera centres by name

# Mean error below which the loss is not scaled down further: of rendered frames it is .3.
LEAST_ERROR_PX = 0.2
# Stretches of a walk whose drifts do not depend on each other.
INDEPENDENT = 3
# Median length of a vector of three independent errors, in their standard deviations.
_MEDIAN_LENGTH = 1.538


def make_points(
    model: pycolmap.Reconstruction, cache: pycolmap.DatabaseCache, seed: int,
    max_error: float = MAX_ERROR_PX,
) -> None:
    """Gives a model of placed cameras the points that its matches show, in place of those it has.

    A point may be `max_error` pixels off its observations.

    Points made anew with better cameras drop what worse ones had joined: of two rooms with drifted
    cameras the worst one came out 1.0 cm off where points were kept, .4 cm where not.
    """
    for number in list(model.points3D):
        model.delete_point3D(number)
    options = pycolmap.IncrementalPipelineOptions()
    mapping, triangulation = options.mapper, options.triangulation
    mapping.num_threads = THREADS
    mapping.random_seed = triangulation.random_seed = seed
    mapping.filter_max_reproj_error = max_error
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = max_error
    worker = pycolmap.IncrementalMapper(cache)
    worker.begin_reconstruction(model)
    for number in sorted(model.reg_image_ids()):
        worker.triangulate_image(triangulation, number)
    worker.complete_and_merge_tracks(triangulation)
    worker.filter_points(mapping)
    worker.end_reconstruction(False)
    model.update_point_3d_errors()


def adjust_with_priors(
    model: pycolmap.Reconstruction, priors: Centers, deviation: float, *,
    constant: Collection[int] = (), seed: int, max_error: float = MAX_ERROR_PX,
) -> None:
    """Adjusts a model in place, each camera held near its prior; drops points that got lost, which
    are more than `max_error` pixels off.

    `deviation` is the standard deviation of a prior, in the model's units; priors that are far off
    count little, by Cauchy's loss. Errors of points count likewise, see `limits.LOSS_SCALE`. The
    intrinsics of the cameras `constant` stay as they are.
    """
    for number in [number for number, point in model.points3D.items() if point.track.length() < 2]:
        model.delete_point3D(number)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = True
    ceres = options.ceres
    ceres.solver_options.num_threads = THREADS
    ceres.solver_options.function_tolerance = TOLERANCE
    ceres.max_num_images_direct_sparse_cpu_solver = MAX_DIRECT
    ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    error = model.compute_mean_reprojection_error() if model.num_points3D() else 0.0
    ceres.loss_function_scale = LOSS_SCALE * max(error, LEAST_ERROR_PX)
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.alignment_ransac.random_seed = seed
    prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    config = pycolmap.BundleAdjustmentConfig()
    for camera in constant:
        config.set_constant_cam_intrinsics(camera)
    held = []
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        config.add_image(number)
        if image.name in priors:
            held.append(pycolmap.PosePrior(
                corr_data_id=image.data_id, position=priors[image.name],
                position_covariance=deviation**2 * np.eye(3),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN))
    pycolmap.create_pose_prior_bundle_adjuster(
        options, prior_options, config, held, model).solve()
    pycolmap.ObservationManager(model).filter_all_points3D(max_error, MIN_RAY_ANGLE_DEG)
    model.update_point_3d_errors()


def measure_deviation(model: pycolmap.Reconstruction, priors: Centers) -> float:
    """Returns the standard deviation to give to each prior, by the cameras of a model; 0 without.

    Errors of tracking drift: all priors together know no more than INDEPENDENT ones, so that each
    counts less the more there are.
    """
    off = [float(np.linalg.norm(image.projection_center() - priors[image.name]))
           for image in map(model.image, model.reg_image_ids()) if image.name in priors]
    if not off:
        return 0.0
    return float(np.median(off) / _MEDIAN_LENGTH * max(1.0, len(off) / INDEPENDENT)**0.5)
