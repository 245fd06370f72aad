"""Frames of wide lenses become a grid of pinhole views that show all of them."""

import io
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from facts import assert_facts
from synthetic import make_capture, place_job

from recon_cli.io.colmap import read_scene
from recon_cli.io.face_frames import read_face_frames
from recon_cli.io.images import read_png, write_png
from recon_cli.scene.faces import pixel_rays
from recon_cli.scene.scene import views_ahead
from recon_cli.sfm.job import Reporter, parse
from recon_cli.sfm.views import undistort
from recon_cli.sfm.views.flat_views import find_views, has_faces

WIDTH, HEIGHT = 160, 120
# 155, 104 and 85 degrees across
WIDE = ("OPENCV_FISHEYE", (57.0, 57.5, 81.0, 59.0, 0.03, -0.006, 0.001, -0.0001))
MIDDLE = ("OPENCV_FISHEYE", (86.0, 86.5, 81.0, 59.0, 0.03, -0.006, 0.001, -0.0001))
NARROW = ("OPENCV", (87.0, 87.0, 80.0, 60.0, 0.01, 0.0, 0.0, 0.0))


def camera_of(lens, number=1):
    model, params = lens
    return pycolmap.Camera(
        camera_id=number, model=model, width=WIDTH, height=HEIGHT, params=params)


def colours(rays):
    """Returns smooth colours of directions [..., 3] in the world."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return 127 + 110 * np.sin(3 * unit + [0, 1, 2])


def frame_rays(camera):
    across, down = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([across.ravel(), down.ravel()], axis=1)
    return pixels, np.asarray(camera.cam_ray_from_img(pixels))


@pytest.mark.parametrize(("lens", "count"), [(WIDE, 4), (MIDDLE, 2), (NARROW, 1)])
def test_as_few_views_as_show_all_of_a_frame(lens, count):
    camera = camera_of(lens)
    views = find_views(camera)
    assert len(views) == count
    assert has_faces(camera) == (count > 1)
    pixels, rays = frame_rays(camera)
    back = np.full_like(pixels, np.nan)
    back[rays[:, 2] > 0] = camera.img_from_cam(rays[rays[:, 2] > 0])
    known = np.linalg.norm(back - pixels, axis=1) < 0.01  # COLMAP's end at a right angle
    assert known.mean() > 0.95
    seen = np.zeros(len(pixels), np.bool_)
    for view in views:
        local = rays @ view.rotation.T
        spots = local[:, :2] / local[:, 2:] * view.camera.params[:2] + view.camera.params[2:]
        seen |= (local[:, 2] > 0) & ((spots > 0) & (
            spots < [view.camera.width, view.camera.height])).all(axis=1)
    assert seen[known].all() or count == 1
    assert all(view.inside is None for view in views) == (count == 1)


def test_views_are_no_larger_than_what_they_show():
    views = find_views(camera_of(WIDE))
    assert sum(view.camera.width * view.camera.height for view in views) < 2.6 * WIDTH * HEIGHT
    for view in views:
        assert view.inside.mean() > 0.6
        assert not (view.own & ~view.inside).any()


def test_a_mask_of_the_frame_and_its_edge_both_count():
    view = find_views(camera_of(WIDE))[0]
    np.testing.assert_array_equal(view.cut_mask(None) == 255, view.inside)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:40] = 0
    cut = view.cut_mask(mask)
    assert not (cut[~view.inside]).any()
    assert 0 < (cut == 255).sum() < view.inside.sum()
    assert not view.shows(view.cut_mask(np.zeros_like(mask)))


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """The folder of the views of a fisheye, the job, its model and what was told."""
    job, model = make_capture(tmp_path_factory.mktemp("wide"), frames=8)
    for number in list(model.cameras):
        camera = model.camera(number)
        lens = camera_of(WIDE, number)
        camera.model, camera.params = lens.model, lens.params
        camera.width, camera.height = WIDTH, HEIGHT
    for image in model.images.values():
        pose = image.cam_from_world().matrix()
        for place, spot in enumerate(image.points2D):
            if spot.has_point3D():
                local = pose[:, :3] @ model.point3D(spot.point3D_id).xyz + pose[:, 3]
                image.points2D[place].xy = image.camera.img_from_cam(local[None])[0]
    job = place_job(job)
    job.frames.mkdir(exist_ok=True)
    _, rays = frame_rays(model.image(next(iter(model.reg_image_ids()))).camera)
    for name in job.names:
        image = model.find_image_with_name(name)
        shown = colours(rays @ image.cam_from_world().rotation.matrix())
        write_png(job.frames / name,
                  np.rint(shown).reshape(HEIGHT, WIDTH, 3).astype(np.uint8))
    (job.out / "sparse").mkdir()
    model.write(job.out / "sparse")
    stream = io.BytesIO()
    undistort.undistort(job, Reporter(stream))
    told = [event for line in stream.getvalue().splitlines()
            if isinstance(event := parse(line), str)]
    return job.out / "undistorted", job, model, told


@pytest.mark.integration
def test_each_pixel_of_a_view_shows_its_direction(wide):
    out, job, _, told = wide
    scene = read_scene(out, held_out=frozenset(), validation=0.0)
    assert len(scene.train) == 4 * len(job.names)
    assert len({(view.camera.width, view.camera.height) for view in scene.train}) > 1
    for view in scene.train:
        counts = read_png(view.mask)[..., 0] == 255
        rays = pixel_rays(view.camera) @ view.camera.viewmat[:3, :3]
        off = np.abs(read_png(view.original) - colours(rays))
        assert counts.mean() > 0.5
        assert off[counts].max() < 6, view.name  # interpolated from a pixel a degree
    assert_facts("\n".join(told), 4, "pinhole")


@pytest.mark.integration
def test_points_lie_where_the_views_see_them(wide):
    out, _, model, _ = wide
    flat = pycolmap.Reconstruction(out / "sparse")
    assert {camera.model_name for camera in flat.cameras.values()} == {"PINHOLE"}
    for image in flat.images.values():
        for spot in image.points2D:
            place = image.cam_from_world() * flat.point3D(spot.point3D_id).xyz
            np.testing.assert_allclose(image.camera.img_from_cam(place), spot.xy, atol=1e-3)
    assert flat.compute_num_observations() == model.compute_num_observations()


def test_a_frame_is_held_out_with_all_of_its_views_and_looks_ahead(wide):
    out, job, model, _ = wide
    assert set(read_face_frames(out).values()) == set(job.names)
    scene = read_scene(out, held_out=frozenset(job.names[:2]), validation=0.0)
    assert len(scene.test) == 8
    ahead = views_ahead(scene.train)
    assert [view.frame for view in ahead] == list(job.names[2:])
    for view in ahead:
        pose = model.find_image_with_name(view.frame).cam_from_world().matrix()
        # the middle of the field of this lens is a degree beside its axis
        assert np.degrees(np.arccos(view.camera.viewmat[2, :3] @ pose[2, :3])) < 3
        np.testing.assert_allclose(view.camera.center, -pose[:, :3].T @ pose[:, 3], atol=1e-9)


def test_the_border_of_a_round_picture_is_not_shown():
    camera = camera_of(WIDE)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - 81, np.arange(HEIGHT) + 0.5 - 59)
    counts = np.hypot(x, y) < 50
    every, within = find_views(camera), find_views(camera, lambda: counts)
    assert all(view.face is not None for view in within)
    assert sum(view.own.size for view in within) < 0.7 * sum(view.own.size for view in every)
    mask = counts * np.uint8(255)
    for view in within:
        assert view.shows(view.cut_mask(mask))


def test_masks_tell_what_counts_in_any_frame_of_a_camera(tmp_path):
    job, _ = make_capture(tmp_path, frames=3)
    job = replace(job, masks=tmp_path / "masks")
    job.masks.mkdir()
    assert undistort._counting(job, job.names) is None
    for place, name in enumerate(job.names):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, place:place + 2] = 255
        write_png(job.masks / name, mask)
    counts = undistort._counting(job, job.names)
    assert counts[:, :4].all()
    assert not counts[:, 4:].any()
    assert undistort._counting(replace(job, masks=None), job.names) is None
