"""The model in the world frame, and its frames without lens distortion.

Originals and denoised twins get the same pinhole camera. COLMAP scales it so that no pixel of the
result lies outside the frame (blank_pixels = 0): a model learns no black borders.
"""

from __future__ import annotations

import dataclasses
import filecmp
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial, reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import format_count
from recon_cli.io.colmap_library import check_model, pycolmap, write_model
from recon_cli.io.images import read_png, write_png
from recon_cli.room.scale import ScaleBetween
from recon_cli.scene.camera import Lens
from recon_cli.scene.faces import is_cube_face, view_name
from recon_cli.sfm.features.sphere import is_panorama
from recon_cli.sfm.job import VERDICT, PlaceJob, Reporter, fresh_folder
from recon_cli.sfm.mapping.mapper import triangulation_angles
from recon_cli.sfm.model_arrays import registered_images, viewmat_of
from recon_cli.sfm.poses.align_world import refuse_contradiction, world_transform
from recon_cli.sfm.poses.depth_points import add_depth_points
from recon_cli.sfm.poses.scale_evidence import ask_device
from recon_cli.sfm.segments.shared_points import to_sim3d
from recon_cli.sfm.verdict.verdict import ModelVerdict
from recon_cli.sfm.views.flat_views import (
    MOST_LOST,
    FlatView,
    find_views,
    has_faces,
    places_in,
    resample,
)
from recon_cli.sfm.views.undistort_faces import write_views
from recon_cli.workspace import atomic
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import PlacedPart, WorldSummary

IMAGES, TWINS, SPARSE, MASKS = "images", "denoised", "sparse", "masks"


def place(job: PlaceJob, report: Reporter) -> None:
    """Writes the views of the job's part in the world frame, and what is known of them."""
    part = job.models / str(job.part)
    model, verdict = pycolmap.Reconstruction(part), None
    tracks = model.compute_num_observations() > 0
    if (part / VERDICT).exists():
        verdict = ModelVerdict.from_json(atomic.read_json(part / VERDICT, dict))
        # a frame that another part holds is not said to have no camera
        held = {name for names in job.parts for name in names}
        unregistered = {name: why for name, why in verdict.unregistered.items() if name not in held}
        lines = tuple(dataclasses.replace(verdict, unregistered=unregistered).lines())
        atomic.write_json(job.out / VERDICT, verdict.to_json())
    placed = PlacedPart(
        points=model.num_points3D(),
        mean_track_length=model.compute_mean_track_length() if tracks else None,
        reprojection_error_px=model.compute_mean_reprojection_error() if tracks else None,
        median_triangulation_angle_deg=(
            float(np.median(triangulation_angles(model))) if tracks else None),
        verdict=verdict.to_json() if verdict else None, lines=lines if verdict else (),
        world=place_model(job, model, verdict), cameras=undistort(job, report))
    StepFolder(job.out).finish(job.steps[-1], placed)


def place_model(
    job: PlaceJob, model: pycolmap.Reconstruction, verdict: ModelVerdict | None
) -> WorldSummary:
    """Writes a model, which it moves into the world frame, into out/sparse.

    The axes of a data set with poses are left as they are, unless it knows up, or says that they
    are arbitrary. ConfigError if a place of --scale-between is unknown; SfmError if what tells the
    scale contradicts itself, unless that is accepted.
    """
    images = {image.name: image for image in registered_images(model)}
    viewmats = {name: viewmat_of(image) for name, image in images.items()}
    device = ask_device(job, model, viewmats)
    if device.depth_scale is not None and job.pose_use != "keep" and job.poses is not None:
        add_depth_points(model, job.poses.parent, job.frames, device.depth_scale,
                         without=job.held_out)
    several = {number for number, camera in model.cameras.items() if has_faces(camera)}
    world = world_transform(
        np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3), viewmats,
        level_views=_level_views(images.values(), viewmats) if (
            job.gravity and device.axes_open) else None, given_up=device.up,
        scale_between=ScaleBetween(*job.scale_between) if job.scale_between else None,
        metric=device.metric, sources=device.sources,
        pinholes={name: _pinhole(image.camera) for name, image in images.items()
                  if image.camera_id not in several})
    refuse_contradiction(world.evidence, accepted=job.accept_weak)
    if device.remark:
        world = dataclasses.replace(world, sentences=(*world.sentences, device.remark))
    if verdict and verdict.scale:
        world = dataclasses.replace(world, evidence=dataclasses.replace(
            world.evidence, scale_spread=verdict.scale.spread))
    model.transform(to_sim3d(world.similarity))
    write_model(model, fresh_folder(job.out / SPARSE))
    summary = world.summary()
    atomic.write_json(job.out / WorldSummary.FILE, summary.to_json())
    return summary


def _level_views(
    images: Iterable[pycolmap.Image], viewmats: Mapping[str, NDArray[np.float64]]
) -> NDArray[np.float64]:  # [C, 4, 4]
    """Returns the views whose x axes are held level: those of cameras, and two of each panorama.

    A tripod, or the camera itself, levels a panorama all around: also a quarter turn further on.
    """
    aside = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    return np.array([*viewmats.values(), *(
        aside @ viewmats[image.name] for image in images if is_panorama(image.camera))])


def _pinhole(camera: pycolmap.Camera) -> Lens:
    """Returns the camera of the undistorted image, to whose pixels --scale-between may point."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    return Lens("PINHOLE", flat.width, flat.height, tuple(flat.params))


def undistort(job: PlaceJob, report: Reporter) -> tuple[Mapping[str, float], ...]:
    """Writes out/undistorted/{images,denoised,sparse} and masks/, and returns its cameras."""
    model = pycolmap.Reconstruction(job.out / SPARSE)
    images = {image.name: image for image in registered_images(model)}
    names = sorted(images)
    report.phase("undistorted", len(names))
    work = fresh_folder(job.out / "undistorted")
    views = {number: find_views(camera, partial(_counting, job, [
        name for name in names if images[name].camera_id == number]))
        for number, camera in model.cameras.items()}
    if any(each[0].face is not None for each in views.values()):
        _tell_faces(views, report)
        return tuple(
            write_views(job, model, work, report, views, (IMAGES, TWINS, MASKS, SPARSE)))
    flat = _write_model(job, model, names[0], work)
    warps = {number: places_in(camera, flat.cameras[number])
             for number, camera in model.cameras.items()}
    masked = {name for name in names if job.masks and (job.masks / name).exists()}
    for folder in (IMAGES, TWINS, *([MASKS] if masked else [])):
        (work / folder).mkdir()

    def write(name: str) -> None:
        warp, target = warps[images[name].camera_id], work / IMAGES / name
        write_png(target, resample(read_png(job.frames / name), warp))
        if filecmp.cmp(job.frames / name, job.denoised / name, shallow=False):
            shutil.copyfile(target, work / TWINS / name)
        else:
            write_png(work / TWINS / name, resample(read_png(job.denoised / name), warp))
        if job.masks is not None and name in masked:  # 255 where most of a pixel counts
            gray = resample(read_png(job.masks / name)[:, :, 0], warp)
            write_png(work / MASKS / name, np.where(gray < 128, 0, 255).astype(np.uint8))

    with ThreadPoolExecutor(job.threads) as pool:
        for count, _ in enumerate(pool.map(write, names), 1):
            report.done(count)
    counts = Counter(image.camera_id for image in registered_images(flat))
    return tuple(
        {"width": camera.width, "height": camera.height, "focal_px": camera.mean_focal_length(),
         "frames": counts[index]}
        for index, camera in sorted(flat.cameras.items()))


def _counting(job: PlaceJob, names: Sequence[str]) -> NDArray[np.bool_] | None:  # [H, W]
    """Returns the pixels that some mask of frames of one size leaves; None for all."""
    if job.masks is None or not all((job.masks / name).exists() for name in names):
        return None
    masks = (read_png(job.masks / name)[:, :, 0] >= 128 for name in names)
    return reduce(np.logical_or, masks)


def _write_model(
    job: PlaceJob, model: pycolmap.Reconstruction, name: str, work: Path
) -> pycolmap.Reconstruction:
    """Writes the undistorted `model` into work/sparse and returns it.

    COLMAP undistorts images with it, at a fifth of OpenCV's speed; it is given a single one.
    """
    between = work / "between"
    pycolmap.undistort_images(between, job.out / SPARSE, job.frames, [name], num_threads=1)
    check_model(model, between / SPARSE)
    (between / SPARSE).rename(work / SPARSE)
    shutil.rmtree(between)
    return pycolmap.Reconstruction(work / SPARSE)


def _tell_faces(views: Mapping[int, Sequence[FlatView]], report: Reporter) -> None:
    """Gives notice of lenses whose frames are seen through faces."""
    for number, each in sorted(views.items()):
        face = each[0].face
        if face is not None and not is_cube_face(view_name("x.png", face)):
            which = "" if len(views) == 1 else f" of camera {number}"
            report.tell(
                f"The lens{which} is so wide that an undistorted picture would leave out more than "
                f"{MOST_LOST:.0%} of each frame: {format_count(len(each), 'pinhole view')} of each "
                "frame, which show all of it, are used instead.")
