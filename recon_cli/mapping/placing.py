"""The model in its world frame: turned upright and scaled before anything is undistorted."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli import atomic
from recon_cli.io.colmap import Pinhole
from recon_cli.io.poses import read_poses
from recon_cli.mapping.job import Job
from recon_cli.mapping.ledger import Result, fresh_folder, publish
from recon_cli.mapping.measure import ScaleBetween
from recon_cli.mapping.world import world_transform
from recon_cli.scene.similarity import Similarity

WORLD = "world.json"  # the similarity from the mapper's frame, and its evidence


def place_model(job: Job) -> Result:
    """Writes the mapper's model, moved into the world frame, into out/sparse.

    The axes of a data set with poses are left as they are: others build on them.

    Returns:
        What `World` says as JSON values.

    Raises:
        ConfigError: a place of --scale-between cannot be made out.
    """
    model = pycolmap.Reconstruction(job.model)
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    world = world_transform(
        np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3),
        {name: _viewmat(image) for name, image in images.items()},
        gravity=job.gravity and not job.known_poses,
        scale_between=ScaleBetween(*job.scale_between) if job.scale_between else None,
        metric=job.known_poses and job.poses is not None and read_poses(job.poses).metric,
        pinholes={name: _pinhole(image.camera) for name, image in images.items()})
    place(model, world.similarity)
    folder = fresh_folder(job.out / "sparse.partial")
    model.write(folder)
    publish(folder, job.out / "sparse")
    atomic.write_json(job.out / WORLD, world.to_json())
    return world.to_json()


def place(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Moves cameras and points of `model`; each observation keeps its reprojection error."""
    model.transform(pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _viewmat(image: pycolmap.Image) -> NDArray[np.float64]:
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    return viewmat


def _pinhole(camera: pycolmap.Camera) -> Pinhole:
    """Returns the camera of the undistorted image, to whose pixels --scale-between may point."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    return Pinhole(flat.width, flat.height, *flat.params)
