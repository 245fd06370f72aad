"""Scores of panoramas: each direction counts once, by its solid angle."""

import numpy as np
import pytest

from recon_cli.evaluation.metrics import psnr, ssim
from recon_cli.evaluation.panoramas import PanoramaPictures, face_weights, join_faces, score_face
from recon_cli.io.views import ReferenceView
from recon_cli.scene.faces import CUBE, face_camera, face_size, grid_faces, view_name

WIDTH = 256
SIZE = face_size(WIDTH / (2 * np.pi))


def views(photo, *, masks=None):
    """The faces of a panorama whose pictures are `photo(place)`, [side, side, 3] of 8 bits."""
    return [ReferenceView(
        face_camera(face, *SIZE, np.eye(4)), photo(place), None if masks is None else masks[place],
        name=view_name("p.png", face), face_of="p.png") for place, face in enumerate(CUBE)]


def gray(value):
    return np.full((SIZE[0], SIZE[0], 3), value, np.uint8)


def score(faces, render):
    weights = face_weights(faces)
    (result,) = join_faces([
        score_face(view, render(place).astype(np.float32), weights[view.name])
        for place, view in enumerate(faces)])
    return result[0]


def test_an_equal_error_everywhere_is_that_of_the_panorama():
    result = score(views(lambda _: gray(100)), lambda _: gray(110) / 255)
    assert result.name == "p.png"
    assert result.psnr_db == pytest.approx(20 * np.log10(255 / 10), abs=1e-4)
    assert result.psnr_8bit_db == pytest.approx(result.psnr_db, abs=1e-4)
    assert result.pixels_scored == pytest.approx(1, rel=0.01)


def test_an_error_in_one_face_counts_by_a_sixth_of_the_sphere():
    result = score(views(lambda _: gray(100)), lambda place: gray(100 + 30 * (place == 4)) / 255)
    assert result.psnr_db == pytest.approx(-10 * np.log10((30 / 255) ** 2 / 6), abs=0.02)


def test_the_overlap_of_faces_does_not_count():
    def render(_):
        image = gray(100) / 255
        image[:2] = 1
        image[:, :2] = 1
        return image

    assert score(views(lambda _: gray(100)), render).psnr_db == 100


def test_corners_weigh_less_than_the_middle():
    def spot(y, x):
        def render(place):
            image = gray(100) / 255
            image[y:y + 4, x:x + 4] += 0.2 * (place == 0)
            return image
        return score(views(lambda _: gray(100)), render).psnr_db

    side, focal = SIZE
    middle, corner = spot(side // 2 - 2, side // 2 - 2), spot(4, 4)
    ray = np.array([(6 - side / 2) / focal, (6 - side / 2) / focal, 1])
    expected = 10 * np.log10(np.linalg.norm(ray) ** 3)
    assert corner - middle == pytest.approx(expected, abs=0.3)


def test_masked_pixels_have_no_part():
    masks = [np.ones((SIZE[0], SIZE[0]), np.bool_) for _ in CUBE]
    masks[5][:] = False
    masks[5][0, 0] = True
    faces = views(lambda _: gray(100), masks=masks)
    result = score(faces, lambda place: gray(100 + 90 * (place == 5)) / 255)
    assert result.psnr_db == 100
    assert result.ssim == pytest.approx(1)
    assert result.pixels_scored == pytest.approx(5 / 6, rel=0.01)


def test_ssim_with_equal_weights_is_the_ordinary_one():
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (40, 50, 3), np.uint8)
    image = np.clip(truth / 255 + rng.normal(scale=0.1, size=truth.shape), 0, 1).astype(np.float32)
    ones = np.ones(truth.shape[:2])
    for padded in (False, True):
        assert ssim(image, truth, padded=padded, weights=ones) == pytest.approx(
            ssim(image, truth, ones > 0, padded=padded))
    assert psnr(image, truth) > 0


def test_pictures_are_joined_once_all_faces_are_there():
    faces = views(lambda place: gray(40 * place))
    pictures = PanoramaPictures(faces)
    found = [picture for view in faces
             for picture in pictures.take(view, view.image.astype(np.float32) / 255)]
    ((name, render, photo, mask),) = found
    assert name == "p.png"
    height, width = photo.shape[:2]
    assert width == 2 * height
    assert (photo[height // 2, width // 2] == 0).all()  # the middle is the front
    assert (photo[0] == 160).all()
    np.testing.assert_allclose(render * 255, photo, atol=0.51)
    assert mask is not None
    assert mask.all()


def wide_views(value, *, masks=None):
    """The faces of a frame of a wide lens, 160 by 80 degrees, in one colour."""
    faces = grid_faces((-80, 80), (-40, 40), 2, 1)
    return [ReferenceView(
        face_camera(face, *SIZE, np.eye(4)), gray(value), None if masks is None else masks[place],
        name=view_name("w.png", face), face_of="w.png") for place, face in enumerate(faces)]


def test_a_frame_of_a_wide_lens_is_scored_whole_by_what_its_faces_show():
    result = score(wide_views(100), lambda _: gray(110) / 255)
    assert result.name == "w.png"
    assert result.psnr_db == pytest.approx(20 * np.log10(255 / 10), abs=1e-4)
    assert result.pixels_scored == 1
    half = [np.ones((SIZE[0], SIZE[0]), np.bool_), np.zeros((SIZE[0], SIZE[0]), np.bool_)]
    assert score(wide_views(100, masks=half), lambda _: gray(9)).pixels_scored == (
        pytest.approx(0.5, rel=0.01))


def test_the_picture_of_a_wide_lens_is_the_part_of_a_panorama_that_it_shows():
    faces = wide_views(90)
    pictures = PanoramaPictures(faces)
    ((name, render, photo, mask),) = [
        picture for view in faces[::-1]
        for picture in pictures.take(view, view.image.astype(np.float32) / 255)]
    assert name == "w.png"
    height, width = photo.shape[:2]
    assert width / height == pytest.approx(175 / 95, rel=0.05)
    assert (photo[height // 2, width // 2] == 90).all()
    assert 0.8 < mask.mean() < 1
    assert render.shape == photo.shape


def test_an_ordinary_view_is_passed_on():
    view = ReferenceView(face_camera(CUBE[0], *SIZE, np.eye(4)), gray(9), None, name="a.png")
    assert face_weights([view]) == {}
    ((name, _, photo, mask),) = PanoramaPictures([view]).take(view, gray(9) / np.float32(255))
    assert (name, mask) == ("a.png", None)
    assert photo is view.image
