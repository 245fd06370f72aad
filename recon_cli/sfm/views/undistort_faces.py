"""The views of a model with panoramas or wide lenses: their frames as pinhole images of faces.

Every view has an image of its own and a pinhole camera, so that any trainer reads them; faces.json
says which views are faces of which frame. A point that a frame sees is seen by the face that is
nearest to it.
"""

from __future__ import annotations

import filecmp
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.io.face_frames import write_face_frames
from recon_cli.io.images import read_png, write_png
from recon_cli.scene.faces import nearest_face, view_name
from recon_cli.sfm.features.sphere import unit_rays
from recon_cli.sfm.job import PlaceJob, Reporter
from recon_cli.sfm.model_arrays import registered_images
from recon_cli.sfm.views.flat_views import FlatView


def write_views(
    job: PlaceJob, model: pycolmap.Reconstruction, work: Path, report: Reporter,
    views: Mapping[int, Sequence[FlatView]],  # by camera
    folders: Sequence[str],  # of images, their denoised twins, masks and the model
) -> list[dict[str, float]]:
    """Writes the views of a model into `work` and returns their cameras, as `PlacedPart`."""
    images, twins, masks, sparse = folders
    number_cameras(views)
    frames = {image.name: image for image in registered_images(model)}
    for folder in (images, twins, sparse):
        (work / folder).mkdir()

    def write(name: str) -> list[bool]:
        """Writes the views of a frame and returns which of them there are."""
        flat = views[frames[name].camera_id]
        mask = None
        if job.masks is not None and (job.masks / name).exists():
            mask = read_png(job.masks / name)[:, :, 0]
        hidden = [view.cut_mask(mask) for view in flat]
        shown = [view.shows(gray) for gray, view in zip(hidden, flat, strict=True)]
        original = read_png(job.frames / name)
        same = filecmp.cmp(job.frames / name, job.denoised / name, shallow=False)
        denoised = original if same else read_png(job.denoised / name)
        for view, gray, there in zip(flat, hidden, shown, strict=True):
            if not there:
                continue
            file = name_view(name, view)
            write_png(work / images / file, view.cut(original))
            if same:
                shutil.copyfile(work / images / file, work / twins / file)
            else:
                write_png(work / twins / file, view.cut(denoised))
            if gray is not None:
                (work / masks).mkdir(exist_ok=True)
                write_png(work / masks / file, gray)
        return shown

    names, shown = sorted(frames), {}
    with ThreadPoolExecutor(job.threads) as pool:
        for count, (name, there) in enumerate(
                zip(names, pool.map(write, names), strict=True), 1):
            shown[name] = there
            report.done(count)
    flat = _build_model(model, views, frames, shown)
    write_model(flat, work / sparse)
    write_face_frames(work, {
        name_view(name, view): name for name in names for view in views[frames[name].camera_id]
        if view.face is not None})
    counts = Counter(image.camera_id for image in registered_images(flat))
    return [{"width": camera.width, "height": camera.height,
             "focal_px": camera.mean_focal_length(), "frames": counts[number]}
            for number, camera in sorted(flat.cameras.items())]


def name_view(frame: str, view: FlatView) -> str:
    """Returns the name of the view of a frame."""
    return frame if view.face is None else view_name(frame, view.face)


def number_cameras(views: Mapping[int, Sequence[FlatView]]) -> None:
    """Gives views of another size or lens than the first of their camera ids of their own."""
    free = max(views) + 1
    for each in views.values():
        ids: dict[tuple[int | float, ...], int] = {}
        for view in each:
            camera = view.camera
            lens = (camera.width, camera.height, *camera.params)
            if lens not in ids:
                ids[lens] = free if ids else camera.camera_id
                free += len(ids) > 1
            camera.camera_id = ids[lens]


def _build_model(
    model: pycolmap.Reconstruction, views: Mapping[int, Sequence[FlatView]],
    frames: Mapping[str, pycolmap.Image], shown: Mapping[str, Sequence[bool]],
) -> pycolmap.Reconstruction:
    """Returns the model of the views, with the points that they see."""
    flat = pycolmap.Reconstruction()
    cameras = {view.camera.camera_id: view.camera
               for number in {image.camera_id for image in frames.values()}
               for view in views[number]}
    for _, camera in sorted(cameras.items()):
        flat.add_camera_with_trivial_rig(camera)
    seen: dict[int, list[tuple[int, int]]] = {}  # (image, place) of the observations of each point
    number = 0
    for name in sorted(frames):
        image = frames[name]
        pose = image.cam_from_world().matrix()
        for view, there, (points, spots) in zip(
                views[image.camera_id], shown[name],
                _share_out(image, views[image.camera_id]), strict=True):
            if not there:
                continue
            number += 1
            flat.add_image_with_trivial_frame(
                pycolmap.Image(
                    image_id=number, name=name_view(name, view), camera_id=view.camera.camera_id,
                    points2D=pycolmap.Point2DList([pycolmap.Point2D(spot) for spot in spots])),
                pycolmap.Rigid3d(view.rotation @ pose))
            for place, point in enumerate(points):
                seen.setdefault(point, []).append((number, place))
    for point, known in sorted(model.points3D.items()):
        if point in seen:
            new = flat.add_point3D(known.xyz, pycolmap.Track(
                [pycolmap.TrackElement(*element) for element in seen[point]]), known.color)
            flat.point3D(new).error = known.error
    return flat


def _share_out(
    image: pycolmap.Image, views: Sequence[FlatView]
) -> Iterator[tuple[list[int], NDArray[np.float64]]]:
    """Yields the ids of the points that each view sees, and their pixels [K, 2]."""
    spots = image.get_observation_points2D()
    points = [spot.point3D_id for spot in spots]
    rays = unit_rays(image.camera, np.array([spot.xy for spot in spots]).reshape(-1, 2))
    nearest = nearest_face(rays, [view.rotation for view in views])
    for place, view in enumerate(views):
        rows = np.flatnonzero(nearest == place)
        local = rays[rows] @ view.rotation.T
        pixels = np.asarray(view.camera.img_from_cam(local)).reshape(-1, 2)
        yield [points[row] for row in rows], pixels
