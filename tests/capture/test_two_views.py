"""Pictures that hold two: circles of two fisheye lenses, and one view for each eye."""

import cv2
import numpy as np
import pytest
from facts import raises
from media import texture
from PIL import Image

from recon_cli.capture.decoded_picture import Packing
from recon_cli.capture.panoramas import choose_projection
from recon_cli.capture.photos import list_photos
from recon_cli.capture.two_views import find_two_views, has_two_circles
from recon_cli.errors import InputError

SIDE_BY_SIDE, TOP_AND_BOTTOM = Packing.SIDE_BY_SIDE, Packing.TOP_AND_BOTTOM


def view(seed, *, height=240, width=320, shift=0):
    """A wall with patterns of several sizes, seen from `shift` pixels further to the right."""
    wall = sum(0.5 * texture(480, 720, seed=seed + coarse, coarseness=coarse)
               for coarse in (12, 40))
    return cv2.GaussianBlur(wall.astype(np.uint8), (0, 0), 1)[:height, shift:shift + width]


def both_eyes(seed, packing=SIDE_BY_SIDE, *, squeezed=False):
    eyes = [view(seed), view(seed, shift=18)]
    axis = 1 if packing is SIDE_BY_SIDE else 0
    if squeezed:
        shape = (160, 240) if axis else (320, 120)
        eyes = [cv2.resize(eye, shape, interpolation=cv2.INTER_AREA) for eye in eyes]
    return np.concatenate(eyes, axis=axis)


def two_circles(seed, *, side=240, axis=1):
    rows, columns = np.mgrid[:side, :side] + 0.5 - side / 2
    inside = np.hypot(rows, columns) < 0.49 * side
    return np.concatenate([
        view(seed + eye, width=side, height=side) * inside[..., None] for eye in (0, 100)], axis)


@pytest.mark.integration
@pytest.mark.parametrize("squeezed", [False, True])
@pytest.mark.parametrize("packing", [SIDE_BY_SIDE, TOP_AND_BOTTOM])
def test_the_views_of_both_eyes_are_told(packing, squeezed):
    pictures = [both_eyes(seed, packing, squeezed=squeezed) for seed in range(3)]
    assert find_two_views(pictures) is packing
    assert not has_two_circles(pictures)


def test_pictures_that_show_nothing_tell_nothing():
    blank = np.full((240, 640, 3), 90, np.uint8)
    assert find_two_views([blank] * 3) is None
    assert find_two_views([blank, both_eyes(1)]) is SIDE_BY_SIDE
    assert find_two_views([]) is None


@pytest.mark.integration
def test_an_ordinary_picture_is_one_view():
    assert find_two_views([view(seed, width=640) for seed in range(3)]) is None
    assert find_two_views([both_eyes(1), view(2, width=640)]) is None


def test_a_wall_that_repeats_across_is_one_view():
    tile = view(1, width=90, height=120)
    wall = np.tile(tile, (2, 7, 1))
    # The camera turns: the halves begin at another place of a tile in nearly every frame.
    assert find_two_views([wall[:, start:start + 500] for start in range(0, 90, 20)]) is None


def test_the_circles_of_two_fisheyes_are_told():
    for axis in (0, 1):
        assert has_two_circles([two_circles(seed, axis=axis) for seed in range(3)])


def test_one_circle_or_none_are_not_two():
    side = 480
    rows, columns = np.mgrid[:side // 2, :side] + 0.5
    one = np.hypot(rows - side / 4, columns - side / 2) < 0.24 * side
    assert not has_two_circles([view(1, width=side) * one[..., None]])
    assert not has_two_circles([view(1, width=side)])
    assert not has_two_circles([np.zeros((240, 480, 3), np.uint8)])


def save(folder, pictures, suffix=".jpg"):
    folder.mkdir(exist_ok=True)
    for name, picture in pictures.items():
        Image.fromarray(picture).save(folder / f"{name}{suffix}", format="JPEG", quality=92)
    return list_photos(sorted(folder.iterdir()), folder).photos


@pytest.mark.integration
@pytest.mark.parametrize(("suffix", "camera"), [
    (".insp", "auto"), (".jpg", "auto"), (".jpg", "equirectangular")])
def test_photos_of_two_fisheyes_are_refused(tmp_path, suffix, camera):
    photos = save(tmp_path / "a", {f"f{seed}": two_circles(seed) for seed in range(4)}, suffix)
    with raises(InputError, "unstitched", "pictures") as error:
        choose_projection("a", photos, camera)
    assert "equirectangular" in error.value.hint
    assert len(choose_projection("a", photos, "perspective").photos) == 4


@pytest.mark.integration
def test_3d_photos_are_refused(tmp_path):
    photos = save(tmp_path / "a", {f"f{seed}": both_eyes(seed) for seed in range(4)})
    with raises(InputError, "views", "both") as error:
        choose_projection("a", photos, "auto")
    assert "50%" in error.value.hint


def test_a_few_among_ordinary_photos_are_left_out(tmp_path):
    photos = save(tmp_path / "a", {f"p{seed}": view(seed) for seed in range(5)} | {
        f"f{seed}": two_circles(seed) for seed in range(2)})
    chosen = choose_projection("a", photos, "auto")
    assert {photo.name for photo in chosen.photos} == {f"p{seed}.jpg" for seed in range(5)}
    assert "f0.jpg" in chosen.notices[0]
