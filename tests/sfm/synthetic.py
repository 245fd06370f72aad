"""Captures without pixels: cameras on a sphere around points, with the matches they would give."""

import numpy as np
import pycolmap

from recon_cli.sfm.job import CameraGroup, MappingJob, PlaceJob


def make_capture(folder, *, frames=20, cameras=1, points=300, seed=0):
    """Writes a database of exact features and matches; returns the job and the true model.

    Each camera takes as many frames.
    """
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = cameras, 1
    options.num_frames_per_rig = frames
    options.num_points3D = points
    options.camera_model_id = pycolmap.CameraModelId.OPENCV
    options.camera_params = [1280, 1280, 512, 384, 0, 0, 0, 0]
    pycolmap.set_random_seed(seed)
    (folder / "frames").mkdir(parents=True)
    with pycolmap.Database.open(folder / "database.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
    names = tuple(sorted(truth.image(i).name for i in truth.reg_image_ids()))
    job = MappingJob(
        frames=folder / "frames", out=folder,
        groups=(CameraGroup(names, 1024, 768),), masks=None, poses=None, pose_use="keep",
        given_points=False, pairs="auto", max_features=2000, min_registered=0.5,
        accept_weak=False, partial=True,
        max_minutes=5.0, seed=0, threads=1, sharpness={}, times={})
    return job, truth


def place_job(job, **changes):
    """Places the model of a job as it is."""
    return PlaceJob(**{
        "frames": job.frames, "denoised": job.frames, "masks": job.masks, "models": job.parts,
        "out": job.out, "parts": (job.names,), "poses": None, "pose_use": "ignore", "part": 1,
        "gravity": True, "scale_between": None, "held_out": (), "accept_weak": False,
        "threads": 2, **changes})


def part(truth, names, *, motion=None):
    """The model of some of the images, moved."""
    model = pycolmap.Reconstruction(truth)
    for index in list(model.reg_image_ids()):
        if model.image(index).name not in names:
            model.deregister_frame(model.image(index).frame_id)
    if motion is not None:
        model.transform(motion)
    return model


def moved():
    """A similarity that is none of the simple ones."""
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3, 0.9]) / np.sqrt(0.95))
    return pycolmap.Sim3d(2.5, turn, np.array([1.0, 2.0, 3.0]))


def center_error(model, truth):
    """Largest distance of a camera from the truth after the best similarity."""
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    found, true = (
        np.array([which.find_image_with_name(name).projection_center() for name in names])
        for which in (model, truth))
    motion = pycolmap.estimate_sim3d(found, true).matrix()
    return np.abs(found @ motion[:, :3].T + motion[:, 3] - true).max()
