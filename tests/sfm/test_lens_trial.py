"""The camera model of a lens shows in the errors of points that its adjustment did not see."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from facts import raises
from test_wide_lens import FISHEYE, HEIGHT, WIDE, WIDTH, camera_of, shots

from recon_cli.errors import SfmError
from recon_cli.sfm.mapping import lens_trial, mapper
from recon_cli.sfm.mapping.lens_trial import BetterLens, convert, find_better_lenses, gain_over
from recon_cli.sfm.verdict import verdict

STRETCHED = ("PINHOLE", (420.0, 340.0, 512.0, 384.0))  # pixels that are not square


def model_of(lens, count=10):
    """The model of a walk through a room, exact but for the noise of its observations."""
    poses, pictures = shots(lens, count)
    camera = camera_of(lens)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    rows = [sorted(picture) for picture in pictures]
    for number, (pose, own, picture) in enumerate(zip(poses, rows, pictures, strict=True), 1):
        model.add_image_with_trivial_frame(pycolmap.Image(
            image_id=number, name=f"{number:03d}.png", camera_id=1,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(picture[row]) for row in own])),
            pycolmap.Rigid3d(pose[:3]))
    tracks = {}
    for number, own in enumerate(rows, 1):
        for place, row in enumerate(own):
            tracks.setdefault(row, []).append((number, place))
    for row, seen in sorted(tracks.items()):
        if len(seen) > 2:
            rays = [(pictures[number - 1][row], poses[number - 1]) for number, _ in seen]
            model.add_point3D(middle_of(camera, rays), pycolmap.Track(
                [pycolmap.TrackElement(*element) for element in seen]), np.zeros(3, np.uint8))
    return model


def middle_of(camera, rays):
    """The point nearest to rays, each of a pixel and a pose."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for pixel, pose in rays:
        ray = pose[:3, :3].T @ camera.cam_ray_from_img(pixel[None])[0]
        across = np.eye(3) - np.outer(ray, ray)
        left += across
        right += across @ (-pose[:3, :3].T @ pose[:3, 3])
    return np.linalg.solve(left, right)


def forced(model, name):
    """A model adjusted with another camera model."""
    wrong = pycolmap.Reconstruction(model)
    camera = wrong.camera(1)
    other = convert(camera, name)
    camera.model, camera.params = other.model, other.params
    for _ in range(3):
        mapper.adjust(wrong)
    return wrong


def test_an_ordinary_lens_is_none_but_what_it_says():
    assert find_better_lenses(model_of(WIDE), [1]) == ()


@pytest.mark.integration
def test_a_fisheye_that_was_mapped_as_an_ordinary_lens_is_found_out():
    (found,) = find_better_lenses(forced(model_of(FISHEYE), "OPENCV"), [1])
    assert (found.camera, found.model, found.better) == (1, "OPENCV", "OPENCV_FISHEYE")
    assert found.is_wrong
    assert found.gain > 10 * found.noise
    assert found.better_px < found.error_px
    assert "--camera-model OPENCV_FISHEYE" in found.sentence()


@pytest.mark.integration
def test_pixels_that_are_not_square_are_found_by_their_second_focal_length():
    (found,) = find_better_lenses(forced(model_of(STRETCHED), "SIMPLE_RADIAL"), [1])
    assert found.better in ("OPENCV", "OPENCV_FISHEYE")
    assert found.is_wrong


@pytest.mark.integration
def test_cameras_that_are_known_and_few_points_are_not_judged():
    wrong = forced(model_of(FISHEYE), "OPENCV")
    assert find_better_lenses(wrong, []) == ()
    for number in sorted(wrong.points3D)[150:]:
        wrong.delete_point3D(number)
    assert find_better_lenses(wrong, [1]) == ()


def test_the_model_that_is_judged_stays_as_it_is():
    model = model_of(WIDE)
    before = [camera.params.tolist() for camera in model.cameras.values()]
    points = {number: point.xyz.tolist() for number, point in model.points3D.items()}
    find_better_lenses(model, [1])
    assert [camera.params.tolist() for camera in model.cameras.values()] == before
    assert {number: point.xyz.tolist() for number, point in model.points3D.items()} == points


def test_only_images_in_the_middle_of_a_long_capture_are_judged(monkeypatch):
    monkeypatch.setattr(lens_trial, "MOST_IMAGES", 6)
    errors = lens_trial.try_lens(lens_trial._middle(model_of(WIDE)), [1], "OPENCV")
    assert len(errors[1]) == 6


def test_a_camera_in_another_model_sees_the_same_pixels():
    camera = camera_of(WIDE)
    other = convert(camera, "OPENCV_FISHEYE")
    rays = np.column_stack([np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    np.testing.assert_allclose(
        other.img_from_cam(rays), camera.img_from_cam(rays), atol=0.2)
    assert (other.width, other.height) == (WIDTH, HEIGHT)


def test_a_gain_is_a_share_of_the_error_with_its_deviation_over_images():
    theirs = np.full(100, 4.0)
    assert gain_over(theirs / 4, theirs) == (pytest.approx(0.5), pytest.approx(0))
    noisy = theirs * np.random.default_rng(0).uniform(0.5, 1.5, 100)
    gain, noise = gain_over(noisy, theirs)
    assert abs(gain) < 3 * noise
    assert 0.01 < noise < 0.03  # .29 / 2 / 10


def test_a_wrong_lens_is_refused_with_the_command_to_type(tmp_path):
    from made_model import MadeModel, along, wall

    made = MadeModel(wall(-4, 4, count=300), along([0.0, 0.5, 1.0]))
    opinion = verdict.examine(made.model(), made.write_database(tmp_path / "d.db"), made.names)
    lens = BetterLens(1, "OPENCV", "OPENCV_FISHEYE", 1.2, 0.7, 0.41, 0.02)
    wrong = dataclasses.replace(opinion, lenses=(lens,), problems=(lens.sentence(),))
    with raises(SfmError, "1.20", "0.70") as caught:
        verdict.check_weak_link(wrong, accept=False)
    assert "--camera-model OPENCV_FISHEYE" in caught.value.hint
    verdict.check_weak_link(wrong, accept=True)
