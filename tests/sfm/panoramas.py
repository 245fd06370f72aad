"""A walk of panoramas without pixels, inside a room of points, with the matches they would give."""

import itertools
from dataclasses import replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation
from synthetic import make_capture

from recon_cli.scene.camera import panorama_lens
from recon_cli.scene.faces import panorama_pixels
from recon_cli.sfm.job import CameraGroup

WIDTH, HEIGHT = 512, 256


def make_panoramas(folder, *, frames=12, points=300, noise_px=0.3, seed=0):
    """Writes a database of features and matches of panoramas; returns the job and the model."""
    job, _ = make_capture(folder, frames=3)
    (folder / "database.db").unlink()
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-1, 1, (points, 3))
    walls /= np.abs(walls).max(axis=1, keepdims=True)
    walls *= [4, 1.5, 3]
    names = tuple(f"{index:06d}.png" for index in range(frames))
    camera = pycolmap.Camera(
        camera_id=1, model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=(WIDTH, HEIGHT))
    truth = pycolmap.Reconstruction()
    truth.add_camera_with_trivial_rig(camera)
    pixels = {}
    for index, name in enumerate(names):
        angle = 2 * np.pi * index / frames
        turn = Rotation.from_euler("yx", [3 * angle, 0.05 * np.sin(angle)]).as_matrix()
        center = np.array([1.6 * np.cos(angle), 0.1 * np.sin(2 * angle), 1.2 * np.sin(angle)])
        pose = np.column_stack([turn, -turn @ center])
        pixels[index + 1] = panorama_pixels((walls - center) @ turn.T, WIDTH, HEIGHT) + (
            rng.normal(scale=noise_px, size=(points, 2)) if noise_px else 0)
        truth.add_image_with_trivial_frame(
            pycolmap.Image(image_id=index + 1, name=name, camera_id=1, points2D=(
                pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels[index + 1]]))),
            pycolmap.Rigid3d(pose))
    for row, place in enumerate(walls):
        truth.add_point3D(place, pycolmap.Track(
            [pycolmap.TrackElement(number, row) for number in pixels]), np.zeros(3, np.uint8))
    truth.update_point_3d_errors()
    _write_database(folder / "database.db", truth, pixels)
    groups = (CameraGroup(names, WIDTH, HEIGHT, lens=panorama_lens(WIDTH, HEIGHT)),)
    return replace(job, groups=groups), truth


def _write_database(path, truth, pixels):
    rows = np.repeat(np.arange(len(pixels[1]), dtype=np.uint32)[:, None], 2, axis=1)
    with pycolmap.Database.open(path) as database:
        database.write_camera(truth.camera(1), use_camera_id=True)
        database.write_rig(truth.rig(1), use_rig_id=True)
        for number, xy in pixels.items():
            database.write_image(pycolmap.Image(
                image_id=number, name=truth.image(number).name, camera_id=1), use_image_id=True)
            database.write_frame(truth.frame(number), use_frame_id=True)
            database.write_keypoints(number, xy.astype(np.float32))
        for first, second in itertools.combinations(pixels, 2):
            database.write_matches(first, second, rows)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = rows
            geometry.cam2_from_cam1 = (truth.image(second).cam_from_world()
                                       * truth.image(first).cam_from_world().inverse())
            database.write_two_view_geometry(first, second, geometry)
