"""What moves along with a 360-degree camera is masked, and the pole below it."""

import cv2
import numpy as np
import pytest

from recon_cli.capture.panorama_masks import POLE_DEG, SIZE, find_carried, pole_mask
from recon_cli.io.images import write_png

WIDTH, HEIGHT = 480, 240


def rooms(folder, *, count=20, operator=True, seed=0):
    """Panoramas of changing walls; behind the camera, at both edges, somebody in dark blue."""
    rng = np.random.default_rng(seed)
    folder.mkdir(exist_ok=True)
    paths = []
    for index in range(count):
        picture = cv2.resize(
            rng.integers(0, 256, (12, 24, 3), np.uint8), (WIDTH, HEIGHT),
            interpolation=cv2.INTER_CUBIC)
        if operator:
            cloth = np.array([30, 32, 45]) * rng.uniform(0.9, 1.1)
            picture[80:210, :25] = cloth
            picture[80:210, -25:] = cloth
        paths.append(folder / f"{index:02d}.png")
        write_png(paths[-1], picture)
    return paths


@pytest.mark.integration
def test_whoever_carries_the_camera_is_found_across_the_seam(tmp_path):
    carried = find_carried(rooms(tmp_path))
    assert carried is not None
    truth = np.zeros(SIZE[::-1], np.bool_)
    truth[40:105, :12] = truth[40:105, -12:] = True
    assert carried[truth].mean() > 0.95
    assert carried[~truth].mean() < 0.1  # what adjoins it


@pytest.mark.integration
def test_a_room_alone_hides_nothing(tmp_path):
    assert find_carried(rooms(tmp_path, operator=False)) is None
    assert find_carried(rooms(tmp_path, count=8)) is None  # too few to say


@pytest.mark.integration
def test_a_ceiling_that_looks_the_same_everywhere_stays(tmp_path):
    paths = rooms(tmp_path, operator=False)
    for path in paths:
        picture = cv2.imread(str(path))
        picture[:70] = 200
        write_png(path, picture)
    assert find_carried(paths) is None


def crop(paths, folder, *, rows=slice(60, 170), columns=slice(None)):
    """Blackens panoramas beyond a crop; returns the masks that say so."""
    masks = []
    for path in paths:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[rows, columns] = 255
        write_png(path, np.where(mask[..., None] > 0, cv2.imread(str(path))[..., ::-1], 0))
        masks.append(folder / f"mask_{path.name}")
        write_png(masks[-1], mask)
    return masks


@pytest.mark.integration
@pytest.mark.parametrize("columns", [slice(None), slice(100, 400)])
def test_what_a_crop_leaves_black_moves_along_with_nobody(tmp_path, columns):
    paths = rooms(tmp_path, operator=False)
    masks = crop(paths, tmp_path, columns=columns)
    assert find_carried(paths, masks) is None
    assert find_carried(paths) is not None  # it is the masks that tell


@pytest.mark.integration
def test_whoever_carries_the_camera_is_found_in_cropped_panoramas(tmp_path):
    paths = rooms(tmp_path)
    carried = find_carried(paths, crop(paths, tmp_path))
    assert carried is not None
    assert carried[35:80, :12].mean() > 0.95
    assert carried[35:80, -12:].mean() > 0.95
    assert not carried[:, 40:-40].any()


@pytest.mark.integration
def test_a_few_masks_hide_nothing_of_the_others(tmp_path):
    paths = rooms(tmp_path)
    few = crop(rooms(tmp_path / "few", count=6), tmp_path, rows=slice(0, 40))
    missing = [tmp_path / "none.png"] * (len(paths) - len(few))
    np.testing.assert_array_equal(find_carried(paths, [*few, *missing]), find_carried(paths))


@pytest.mark.parametrize("height", [90, 768])
def test_the_pole_is_a_cone_around_the_lowest_point(height):
    mask = pole_mask(2 * height, height)
    assert (mask == 0).all(axis=1).sum() == round(height * POLE_DEG / 180)
    assert (mask[-1] == 0).all()
    assert (mask[:height * 3 // 4] == 255).all()
