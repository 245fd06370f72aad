"""Panoramas are told by metadata or by what they show, and never mixed with photos."""

import numpy as np
import pytest
from facts import assert_facts, raises
from media import texture
from PIL import Image
from scipy.spatial.transform import Rotation

from recon_cli.capture.images import inspect_photo
from recon_cli.capture.panoramas import (
    choose_projection,
    fill_sphere,
    find_panoramas,
    wraps_around,
)
from recon_cli.capture.xmp import PanoramaArea
from recon_cli.errors import InputError

XMP = b'<r GPano:ProjectionType="equirectangular"/>'
WAVES = np.random.default_rng(0).normal(scale=6, size=(3, 3))


def sphere(yaw, *, width=256, turn=None):
    """Returns a panorama of coloured waves on a sphere, turned by `yaw` and by a rotation."""
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi + yaw
    latitude = np.pi / 2 - (np.arange(width // 2) + 0.5) / (width // 2) * np.pi
    rays = np.stack([
        np.cos(latitude)[:, None] * np.sin(longitude), np.sin(latitude)[:, None] + 0 * longitude,
        np.cos(latitude)[:, None] * np.cos(longitude)], -1)
    rays = rays if turn is None else rays @ turn
    return np.rint(127 + 100 * np.sin(rays @ WAVES)).astype(np.uint8)


def photos(folder, pictures, **options):
    folder.mkdir(exist_ok=True)
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{index}.jpg", quality=95, **options)
    return [inspect_photo(path) for path in sorted(folder.iterdir())]


def test_a_panorama_ends_where_it_begins_and_a_photo_does_not():
    for yaw in range(6):
        assert wraps_around(sphere(yaw))
    for seed in range(20):
        assert not wraps_around(texture(128, 256, seed=seed, coarseness=32))
    assert not wraps_around(np.full((128, 256, 3), 90, np.uint8))  # a wall is like itself


def test_a_panorama_whose_horizon_is_not_level_is_one_too():
    quats = np.random.default_rng(0).normal(size=(30, 4))
    for turn in Rotation.from_quat(quats).as_matrix():
        assert wraps_around(sphere(0.0, turn=turn))


def test_panoramas_are_told_by_their_metadata(tmp_path):
    listed = photos(tmp_path / "a", [texture(64, 128)] * 2, xmp=XMP)
    listed += photos(tmp_path / "b", [texture(64, 128)] * 3)
    assert find_panoramas(listed) == listed[:2]


def test_panoramas_without_metadata_are_told_by_what_they_show(tmp_path):
    listed = photos(tmp_path / "a", [sphere(yaw) for yaw in range(5)])
    others = photos(tmp_path / "b", [texture(96, 128)] * 3)
    assert find_panoramas([*listed, *others]) == listed
    assert find_panoramas(listed[:2]) == []  # two may look so by chance


def test_photos_twice_as_wide_as_high_stay_photos(tmp_path):
    assert find_panoramas(photos(
        tmp_path / "a", [texture(128, 256, seed=seed, coarseness=32) for seed in range(9)])) == []


@pytest.mark.integration
def test_a_folder_is_used_as_what_it_holds_more_of(tmp_path):
    panoramas = photos(tmp_path / "a", [sphere(yaw) for yaw in range(5)])
    others = photos(tmp_path / "b", [texture(96, 128)] * 7)
    chosen = choose_projection("room", [*panoramas, *others[:4]], "auto")
    assert (chosen.panoramas, list(chosen.photos)) == (True, panoramas)
    assert_facts(chosen.notices[1], 4, "pictures", "left")
    chosen = choose_projection("room", [*panoramas, *others], "auto")
    assert (chosen.panoramas, list(chosen.photos)) == (False, others)
    assert_facts(chosen.notices[0], 5, "panoramas", "left")


def test_too_few_of_either_are_refused(tmp_path):
    panoramas = photos(tmp_path / "a", [sphere(yaw) for yaw in range(2)], xmp=XMP)
    with raises(InputError, 2, "equirectangular") as error:
        choose_projection("room", panoramas, "auto")
    assert_facts(error.value.hint, "wide", "high")


def test_cylinders_are_no_panoramas_of_the_sphere(tmp_path):
    xmp = b'<r GPano:ProjectionType="cylindrical"/>'
    cylinders = photos(tmp_path / "a", [texture(64, 128)] * 4, xmp=xmp)
    with raises(InputError, 0, "equirectangular"):
        choose_projection("room", cylinders, "auto")


@pytest.mark.integration
def test_a_band_of_a_panorama_without_metadata_is_no_ordinary_photo(tmp_path):
    bands = photos(tmp_path / "a", [sphere(yaw)[30:100] for yaw in range(5)])
    with raises(InputError, 5, 0, "panoramas") as error:
        choose_projection("room", bands, "auto")
    assert "metadata" in error.value.hint
    assert choose_projection("room", bands, "perspective").photos == tuple(bands)
    others = photos(tmp_path / "b", [texture(96, 128)] * 4)
    chosen = choose_projection("room", [*bands, *others], "auto")
    assert (chosen.panoramas, list(chosen.photos)) == (False, others)
    assert_facts(chosen.notices[0], 5, "panoramas", "left")


@pytest.mark.integration
@pytest.mark.parametrize("rows", [16, 40, 60])
def test_wide_photos_stay_photos(tmp_path, rows):
    wide = photos(tmp_path / "a", [
        texture(128, 256, seed=seed, coarseness=32)[:rows] for seed in range(9)])
    assert choose_projection("room", wide, "auto").photos == tuple(wide)


def test_what_was_asked_for_is_done(tmp_path):
    panoramas = photos(tmp_path / "a", [sphere(yaw) for yaw in range(5)], xmp=XMP)
    chosen = choose_projection("room", panoramas, "perspective")
    assert (chosen.panoramas, list(chosen.photos)) == (False, panoramas)
    walls = photos(tmp_path / "b", [texture(128, 256, coarseness=32)] * 3)
    assert choose_projection("room", walls, "equirectangular").panoramas
    odd = photos(tmp_path / "c", [texture(96, 128)])
    with raises(InputError, 1, 4, "wide") as error:
        choose_projection("room", [*walls, *odd], "equirectangular")
    assert "0.jpg (128x96)" in error.value.message


def test_a_cropped_panorama_lies_in_the_sphere_where_its_metadata_says():
    rgb = np.full((40, 160, 3), 90, np.uint8)
    area = PanoramaArea(left=40, top=80, width=320, height=80, full_width=400, full_height=200)
    full, mask = fill_sphere(rgb, None, area)  # at half its size
    assert full.shape == (100, 200, 3)
    shown = np.zeros((100, 200), np.uint8)
    shown[40:80, 20:180] = 255
    np.testing.assert_array_equal(mask, shown)
    np.testing.assert_array_equal(full[..., 1] > 0, shown > 0)
