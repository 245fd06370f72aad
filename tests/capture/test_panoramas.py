"""Panoramas are told by metadata or by what they show, and never trained on as photos."""

import numpy as np
from media import texture
from PIL import Image

from recon_cli.capture.images import inspect_photo
from recon_cli.capture.panoramas import find_panoramas, panorama_error, wraps_around

XMP = b'<r GPano:ProjectionType="equirectangular"/>'
WAVES = np.random.default_rng(0).normal(scale=6, size=(3, 3))


def sphere(yaw, *, width=256):
    """Returns a panorama of coloured waves on a sphere, turned by `yaw`."""
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi + yaw
    latitude = np.pi / 2 - (np.arange(width // 2) + 0.5) / (width // 2) * np.pi
    rays = np.stack([
        np.cos(latitude)[:, None] * np.sin(longitude), np.sin(latitude)[:, None] + 0 * longitude,
        np.cos(latitude)[:, None] * np.cos(longitude)], -1)
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


def test_the_error_says_how_to_cut_them(tmp_path):
    listed = photos(tmp_path / "my pano", [sphere(0)] * 3, xmp=XMP)
    error = panorama_error("my pano", listed, 3)
    assert "3 of the 3 pictures in my pano are 360-degree panoramas" in error.message
    assert f"'{tmp_path}/my pano'/*.jpg" in error.hint
    assert "v360=e:flat:yaw=$y:h_fov=90:v_fov=90:w=64:h=64" in error.hint
