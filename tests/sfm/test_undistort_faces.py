"""Panoramas become the faces of a cube, which other trainers read as pinhole images."""

import io
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from panoramas import HEIGHT, WIDTH, make_panoramas
from scipy.spatial.transform import Rotation
from synthetic import place_job

from recon_cli.io.colmap import read_scene
from recon_cli.io.face_frames import read_face_frames
from recon_cli.io.images import read_png, write_png
from recon_cli.scene.faces import CUBE, panorama_rays, pixel_rays, view_name
from recon_cli.sfm.features.face_images import PICTURES, cube_warps, cut_face
from recon_cli.sfm.job import Reporter
from recon_cli.sfm.views import undistort


def colours(rays):
    """Returns smooth colours of directions [..., 3] in the world."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return 127 + 110 * np.sin(3 * unit + [0, 1, 2])


@pytest.fixture(scope="module")
def faces(tmp_path_factory):
    """The folder of the views, the job and the model; the first panorama has masks."""
    job, model = make_panoramas(tmp_path_factory.mktemp("faces"), frames=8, noise_px=0)
    job = replace(job, masks=job.out / "masks", threads=2)
    job.masks.mkdir()
    for place, name in enumerate(job.names):
        image = model.find_image_with_name(name)
        world = panorama_rays(WIDTH, HEIGHT) @ image.cam_from_world().rotation.matrix()
        write_png(job.frames / name, np.rint(colours(world)).astype(np.uint8))
        if place == 0:
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[HEIGHT // 2:, :] = 0
            write_png(job.masks / name, mask)
    (job.out / "sparse").mkdir()
    model.write(job.out / "sparse")
    undistort.undistort(place_job(job), Reporter(io.BytesIO()))
    return job.out / "undistorted", job, model


@pytest.mark.integration
def test_each_pixel_of_a_face_shows_its_direction(faces):
    out, job, _ = faces
    scene = read_scene(out, held_out=frozenset(), validation=0.0)
    for view in scene.train:
        rays = pixel_rays(view.camera) @ view.camera.viewmat[:3, :3]
        off = np.abs(read_png(view.original) - colours(rays))
        assert off.max() < 6, view.name  # interpolated from 1.4 pixels a degree
    assert len(scene.train) == 6 * len(job.names) - 1


def test_faces_are_sharper_than_bilinear_ones_across_seam_and_poles():
    width = 256
    rays = panorama_rays(width, width // 2)
    turned = Rotation.from_euler("xy", [90, 180], degrees=True).as_matrix()

    def fine(rays):  # six pixels a wave at least
        unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return 127 + 100 * np.sin(width / 6 * (unit @ [0.6, 0.64, 0.48]))

    def error(interpolation, turn):
        picture = np.rint(fine(rays @ turn)).astype(np.uint8)
        off = []
        for face, warp in cube_warps(width, width // 2):
            truth = fine(pixel_rays(warp.camera(face, np.eye(4))) @ face.rotation @ turn)
            off.append((cut_face(picture, warp, interpolation) - truth)[warp.own > 0])
        return [float(np.sqrt((one**2).mean())) for one in off]

    for turn in (np.eye(3), turned):  # with a pole in front
        sharp, soft = error(PICTURES, turn), error(cv2.INTER_LINEAR, turn)
        assert max(np.divide(sharp, soft)) < 0.8


@pytest.mark.integration
def test_points_lie_where_the_faces_see_them(faces):
    out, _, model = faces
    flat = pycolmap.Reconstruction(out / "sparse")
    assert {camera.model_name for camera in flat.cameras.values()} == {"PINHOLE"}
    masked = sum(point.track.length() for point in model.points3D.values()) - (
        sum(point.track.length() for point in flat.points3D.values()))
    assert 0 < masked < 0.1 * model.compute_num_observations()  # of the face that is not there
    for image in flat.images.values():
        for spot in image.points2D:
            place = image.cam_from_world() * flat.point3D(spot.point3D_id).xyz
            np.testing.assert_allclose(image.camera.img_from_cam(place), spot.xy, atol=1e-3)


def test_masked_pixels_are_masked_in_the_faces_and_a_hidden_face_is_left_out(faces):
    out, job, _ = faces
    first = job.names[0]
    names = {face.name: view_name(first, face) for face in CUBE}
    assert not (out / "images" / names["down"]).exists()
    assert (read_png(out / "masks" / names["up"])[..., 0] == 255).all()
    mask = read_png(out / "masks" / names["front"])[..., 0]
    side = len(mask)
    assert (mask[:side // 2 - 1] == 255).all()
    assert (mask[side // 2 + 1:] == 0).all()


def test_the_record_says_which_views_are_faces_of_which_frame(faces):
    out, job, _ = faces
    frames = read_face_frames(out)
    assert set(frames.values()) == set(job.names)
    assert frames[view_name(job.names[1], CUBE[0])] == job.names[1]


def test_a_panorama_is_held_out_with_all_of_its_faces(faces):
    out, job, _ = faces
    scene = read_scene(
        out, held_out=frozenset({job.names[1], "lost.png"}), validation=0.3)
    assert {view.frame for view in scene.test} == {job.names[1]}
    assert len(scene.test) == 6
    assert scene.unregistered_test == ("lost.png",)
    assert len({view.frame for view in scene.validation}) == 2
    assert not {view.frame for view in scene.validation} & {view.frame for view in scene.train}
