"""The model in the world frame, and its frames without lens distortion.

Originals and denoised twins get the same pinhole camera. COLMAP scales it so that no pixel of the
result lies outside the frame (blank_pixels = 0): a model learns no black borders.
"""

from __future__ import annotations

import dataclasses
import filecmp
import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap import Pinhole
from recon_cli.io.colmap_library import check_model, pycolmap, write_model
from recon_cli.io.images import read_png, write_png
from recon_cli.io.training_scene import held_out_names
from recon_cli.room.scale import ScaleBetween
from recon_cli.sfm.align_world import refuse_contradiction, world_transform
from recon_cli.sfm.depth_points import add_depth_points
from recon_cli.sfm.job import VERDICT, MappingJob, Reporter, fresh_folder, publish
from recon_cli.sfm.parts import check_part
from recon_cli.sfm.results import PlacedResult, UndistortedResult
from recon_cli.sfm.scale_evidence import ask_device
from recon_cli.sfm.shared_points import to_sim3d
from recon_cli.sfm.sphere import is_panorama
from recon_cli.sfm.undistort_faces import write_views
from recon_cli.workspace import atomic
from recon_cli.workspace.summaries import WorldSummary

MOST_LOST = 0.1  # of a frame by undistortion, above which it is told
IMAGES, TWINS, SPARSE, MASKS = "images", "denoised", "sparse", "masks"


def place_model(job: MappingJob) -> PlacedResult:
    """Writes the model of the job's part, moved into the world frame, into out/sparse.

    The axes of a data set with poses are left as they are, unless it knows up, or says that they
    are arbitrary. ConfigError if the part, or a place of --scale-between, is unknown; SfmError if
    what tells the scale contradicts itself, unless that is accepted.
    """
    check_part(job)
    part = job.parts / str(job.part)
    model = pycolmap.Reconstruction(part)
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    viewmats = {name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
                for name, image in images.items()}
    device = ask_device(job, model, viewmats)
    if device.depth_scale is not None and job.pose_use != "keep" and job.poses is not None:
        ingest = job.poses.parent
        add_depth_points(model, ingest, job.frames, device.depth_scale,
                         without=held_out_names(ingest))
    world = world_transform(
        np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3), viewmats,
        gravity=job.gravity and device.axes_open, given_up=device.up,
        scale_between=ScaleBetween(*job.scale_between) if job.scale_between else None,
        metric=device.metric, sources=device.sources,
        pinholes={name: _pinhole(image.camera) for name, image in images.items()
                  if not is_panorama(image.camera)})
    refuse_contradiction(world.evidence, accepted=job.accept_weak)
    if device.remark:
        world = dataclasses.replace(world, sentences=(*world.sentences, device.remark))
    model.transform(to_sim3d(world.similarity))
    folder = fresh_folder(job.out / "sparse.partial")
    write_model(model, folder)
    publish(folder, job.out / "sparse")
    summary = world.summary()
    atomic.write_json(job.out / WorldSummary.FILE, summary.to_json())
    if (part / VERDICT).exists():
        atomic.write_json(job.out / VERDICT, atomic.read_json(part / VERDICT))
    return PlacedResult(world=summary)


def _pinhole(camera: pycolmap.Camera) -> Pinhole:
    """Returns the camera of the undistorted image, to whose pixels --scale-between may point."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    return Pinhole(flat.width, flat.height, *flat.params)


def undistort(job: MappingJob, report: Reporter) -> UndistortedResult:
    """Writes out/undistorted/{images,denoised,sparse} and masks/, and returns its cameras."""
    model = pycolmap.Reconstruction(job.out / SPARSE)
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    names = sorted(images)
    report.phase("undistorted", len(names))
    work = fresh_folder(job.out / "undistorted.partial")
    if any(map(is_panorama, model.cameras.values())):
        sizes = write_views(job, model, work, report, _flatten, (IMAGES, TWINS, MASKS, SPARSE))
        publish(work, job.out / "undistorted")
        return UndistortedResult(cameras=tuple(sizes))
    flat = _write_model(job, model, names[0], work)
    warps = {number: _warp(camera, flat.cameras[number])
             for number, camera in model.cameras.items()}
    _tell_lost(model, warps, report)
    masked = {name for name in names if job.masks and (job.masks / name).exists()}
    for folder in (IMAGES, TWINS, *([MASKS] if masked else [])):
        (work / folder).mkdir()

    def write(name: str) -> None:
        warp, target = warps[images[name].camera_id], work / IMAGES / name
        write_png(target, _remap(read_png(job.frames / name), warp))
        if filecmp.cmp(job.frames / name, job.denoised / name, shallow=False):
            shutil.copyfile(target, work / TWINS / name)
        else:
            write_png(work / TWINS / name, _remap(read_png(job.denoised / name), warp))
        if job.masks is not None and name in masked:  # 255 where most of a pixel counts
            gray = _remap(read_png(job.masks / name)[:, :, 0], warp)
            write_png(work / MASKS / name, np.where(gray < 128, 0, 255).astype(np.uint8))

    with ThreadPoolExecutor(job.threads) as pool:
        for count, _ in enumerate(pool.map(write, names), 1):
            report.done(count)
    counts = Counter(flat.image(i).camera_id for i in flat.reg_image_ids())
    cameras = tuple(
        {"width": camera.width, "height": camera.height, "focal_px": camera.mean_focal_length(),
         "frames": counts[index]}
        for index, camera in sorted(flat.cameras.items()))
    publish(work, job.out / "undistorted")
    return UndistortedResult(cameras=cameras)


def _write_model(
    job: MappingJob, model: pycolmap.Reconstruction, name: str, work: Path
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


def _flatten(
    camera: pycolmap.Camera
) -> tuple[pycolmap.Camera, Callable[[NDArray[np.uint8]], NDArray[np.uint8]]]:
    """Returns the camera of the undistorted image, and what makes that of a frame."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    flat.camera_id = camera.camera_id
    warp = _warp(camera, flat)
    return flat, lambda image: _remap(image, warp)


def _warp(camera: pycolmap.Camera, flat: pycolmap.Camera) -> NDArray[np.float32]:  # [H, W, 2]
    """Returns where each pixel of the undistorted image lies in the frame (OpenCV: 0, 0 is the
    middle of the first pixel)."""
    x, y = np.meshgrid(np.arange(flat.width) + 0.5, np.arange(flat.height) + 0.5)
    rays = np.asarray(flat.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
    places = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    return (places - 0.5).reshape(flat.height, flat.width, 2).astype(np.float32)


def _tell_lost(
    model: pycolmap.Reconstruction, warps: Mapping[int, NDArray[np.float32]], report: Reporter
) -> None:
    """Gives notice of lenses of which one pinhole picture shows much less than the frame."""
    for number, warp in sorted(warps.items()):
        camera = model.camera(number)
        lost = 1 - covered_share(warp, camera.width, camera.height)
        if lost > MOST_LOST:
            which = "" if len(warps) == 1 else f" of camera {number}"
            report.tell(
                f"The lens{which} is so wide that undistorted pictures leave out {lost:.0%} of "
                "each frame, at its edges: what only the edges show is not trained. Cameras are "
                "found with the whole frames.")


def covered_share(warp: NDArray[np.float32], width: int, height: int) -> float:
    """Returns the share of a frame that an undistorted image shows, by its `_warp` [H, W, 2]."""
    border = np.concatenate([warp[0], warp[:, -1], warp[-1, ::-1], warp[::-1, 0]])
    # through the middles of the outer pixels, half a pixel inside
    return float(cv2.contourArea(border)) / ((width - 1) * (height - 1))


def _remap(image: NDArray[np.uint8], warp: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(cv2.remap(
        image, warp, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
